"""Paths, ports and wait functions for all tests."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    # The codec tests import this module without Zenoh (tests/system/arm64).
    import zenoh

REPOSITORY = Path(__file__).resolve().parents[2]
GOLDEN_FOLDER = REPOSITORY / "tests" / "golden"


WAIT_S = 300.0
"""Default limit of waits: only a test that fails waits so long."""


def free_port() -> int:
    """Return a TCP port of `free_ports`."""
    from sonarpost.cli.demo.settings import free_ports  # the codec tests have no drivers of modems

    return free_ports(1)[0]


def eventually(condition: Callable[[], bool], timeout_s: float = WAIT_S, what: str = "condition") -> None:
    """Wait until `condition()` is true; fail the test after the time-out."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"{what} did not come true within {timeout_s} s")
        time.sleep(0.01)  # noqa: TID251 the poll of every wait


def publish_once(session: zenoh.Session, key: str, payload: bytes, encoding: str | None = None) -> None:
    """Publish like a program without an outbox, after a subscriber has appeared."""
    publisher = session.declare_publisher(key, encoding=encoding)
    eventually(lambda: publisher.matching_status.matching, what=f"subscriber of {key}")
    publisher.put(payload)
    publisher.undeclare()  # type: ignore[no-untyped-call]  # the stub has no return type
