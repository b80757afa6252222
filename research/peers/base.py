"""What the benchmarks do with every peer: start its two servers, fill the sender, measure the drain to the receiver."""

import os
import shutil
import socket
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

START_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 30.0
POLL_S = 0.02


class AbsentError(Exception):
    """A program or a package of the peer is not installed; the text says how to install it."""


class StartError(Exception):
    """A server of the peer ended, or did not answer in time."""


@dataclass(frozen=True)
class Drained:
    """Result of a drain.

    Attributes:
        records: Records at the receiver.
        seconds: From the connection of the sender to the last of them.
        per_s: Records a second, from the first arrival on: the time to connect and to start the transfer is left out.
    """

    records: int
    seconds: float
    per_s: float


class Peer(ABC):
    """A sender and a receiver with storage on disk, which start empty."""

    @abstractmethod
    def fill(self, payloads: Sequence[bytes]) -> None:
        """Empty both sides, then store records durably at the sender, which does not send them yet."""

    @abstractmethod
    def connect(self) -> None:
        """Start the transfer to the receiver."""

    @abstractmethod
    def stored(self) -> int:
        """Return the number of records that the receiver has stored since `fill`."""

    def drain(self, count: int, timeout_s: float = 300.0) -> Drained:
        """Start the transfer, and wait until `count` records are stored at the receiver or the time is over."""
        started_s = time.perf_counter()
        self.connect()
        first, first_s, stored, now_s = 0, started_s, 0, started_s
        while stored < count and now_s < started_s + timeout_s:
            time.sleep(POLL_S)
            stored, now_s = self.stored(), time.perf_counter()
            if not first and stored:
                first, first_s = stored, now_s
        if stored > first:
            return Drained(stored, now_s - started_s, (stored - first) / (now_s - first_s))
        return Drained(stored, now_s - started_s, stored / (now_s - started_s))


def program(name: str, install: str, folder: str | None = None) -> str:
    """Return the path of a program: in `folder`, in `PATH`, or beside the Python interpreter.

    Raises:
        AbsentError: It is in none of them.
    """
    for path in (folder, os.environ.get("PATH"), str(Path(sys.executable).parent)):
        if path is not None and (found := shutil.which(name, path=path)) is not None:
            return found
    raise AbsentError(f"{name} is not installed ({install})")


@contextmanager
def server(
    command: Sequence[str], port: int, log: Path, environment: Mapping[str, str] | None = None
) -> Iterator[None]:
    """Run a server that listens on a port of this host; it ends with the block, or with this process.

    Raises:
        StartError: It does not accept connections.
    """
    with log.open("wb") as output:
        process = subprocess.Popen(
            ["setpriv", "--pdeathsig", "TERM", *command],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=environment,
        )
    try:
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            if process.poll() is not None or time.monotonic() > deadline_s:
                raise StartError(f"{command[0]} does not listen on port {port}: {log.read_text()[-2000:]}")
            time.sleep(0.02)
        yield
    finally:
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
