"""Paths, ports and wait functions for all tests."""

from __future__ import annotations

import itertools
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from random import SystemRandom
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    # The codec tests import this module without Zenoh (tests/system/arm64).
    import zenoh

REPOSITORY = Path(__file__).resolve().parents[2]
GOLDEN_FOLDER = REPOSITORY / "tests" / "golden"

WAIT_S = 300.0
"""Default limit of waits: only a test that fails waits so long."""
LONG_WAIT_S = 1500.0
"""Limit of waits for a whole demo, or for the compilation of a codec, which takes 20 s on an idle machine."""
PORTS = range(10_000, 32_000)
"""Ports of tests: below those of outgoing connections, which could take a port between two uses."""


def worker_ports() -> Iterator[int]:
    """Return the ports of this worker of pytest-xdist in turn, without end: no other worker has them."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
    own = PORTS[worker :: int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))]
    # Another run of the tests on this host starts at another port; seeded by the system, not by a test.
    first = SystemRandom().randrange(len(own))
    return itertools.cycle([*own[first:], *own[:first]])


_worker_ports = worker_ports()


def free_port() -> int:
    """Return a TCP port of this worker that was free a moment ago; the same one only after some thousands of others."""
    while True:
        port = next(_worker_ports)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        return port


def eventually(condition: Callable[[], bool], timeout_s: float = WAIT_S, what: str = "condition") -> None:
    """Wait until `condition()` is true; fail the test after the time-out."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"{what} did not come true within {timeout_s} s")
        time.sleep(0.01)  # noqa: TID251 the poll of every wait


@contextmanager
def running(service: Any) -> Iterator[Any]:
    """Start a service; it is stopped when the context ends."""
    assert service.start()
    try:
        yield service
    finally:
        service.stop()


def publish_once(session: zenoh.Session, key: str, payload: bytes, encoding: str | None = None) -> None:
    """Publish like a program without an outbox, after a subscriber has appeared."""
    publisher = session.declare_publisher(key, encoding=encoding)
    eventually(lambda: publisher.matching_status.matching, what=f"subscriber of {key}")
    publisher.put(payload)
    publisher.undeclare()  # type: ignore[no-untyped-call]  # the stub has no return type
