"""A vessel and a shore in real processes, the link between them, and an exact account of what arrived.

Real are both routers, relay and c2, each a process with its own store. The test itself stands in for the decompressor:
its outbox owes `image/reconstructed` to the relay.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
import pytest
import tifffile
import zenoh
from PIL import Image

from builders.common import REPOSITORY, free_port
from builders.faulty_link import FaultyLink
from builders.feeder import VESSEL, Feeder
from sonarpost import wire
from sonarpost.bus.session import open_with_retry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Health, ReconstructedImage
from sonarpost.parent_process import EXIT_WITH_PARENT

SHORE = "shore-1"
PROCESSES = ("router-vessel", "router-shore", "relay", "c2")
Name = tuple[str, str, int]


@dataclass
class Options:
    """What a coast is made of.

    Attributes:
        link_bytes_per_s: Of the link, each direction.
        relay, c2: More lines for their tables.
        vessel_state, shore_state, shore_out: Folders, by default in the coast's own.
        launcher: What runs a process's module, by process; by default the interpreter.
        environment: More of it, by process.
        shore_prefix: Command that the shore's processes are run by (another network namespace).
        shore_host: Address of the shore's router; with another than this host's there is no FaultyLink.
    """

    link_bytes_per_s: float | None = None
    relay: str = ""
    c2: str = ""
    vessel_state: Path | None = None
    shore_state: Path | None = None
    shore_out: Path | None = None
    launcher: dict[str, Sequence[str]] = field(default_factory=dict)
    environment: dict[str, dict[str, str]] = field(default_factory=dict)
    shore_prefix: Sequence[str] = ()
    shore_host: str = "127.0.0.1"


class Coast:
    """Processes of a vessel and a shore; a context manager that leaves nothing running."""

    def __init__(self, folder: Path, options: Options | None = None) -> None:
        self.folder = folder
        self.options = options or Options()
        self.vessel_state = self.options.vessel_state or folder / "state" / VESSEL
        self.shore_state = self.options.shore_state or folder / "state" / SHORE
        self.out = self.options.shore_out or folder / "out"
        self.ports = {"router-vessel": free_port(), "router-shore": free_port()}
        self.link: FaultyLink | None = None
        self.expected: dict[Name, ReconstructedImage] = {}
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._logs: list[IO[bytes]] = []
        self._feeder: Feeder | None = None
        self._watchers: list[zenoh.Session] = []
        self.health: dict[str, Health] = {}

    def __enter__(self) -> Coast:
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.options.shore_host == "127.0.0.1":
            self.link = FaultyLink(self.ports["router-shore"], self.options.link_bytes_per_s)
        self._write_config()
        try:
            for name in PROCESSES:
                self.start(name)
            self.start_feeder()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Processes

    def _endpoint(self, router: str) -> str:
        host = self.options.shore_host if router == "router-shore" else "127.0.0.1"
        return f"tcp/{host}:{self.ports[router]}"

    def _write_config(self) -> None:
        common = "health_interval_s = 0.2\n"
        (self.folder / "relay.toml").write_text(
            f'[platform]\nid = "{VESSEL}"\nrouter = ["{self._endpoint("router-vessel")}"]\n'
            f'state_dir = "{self.vessel_state}"\n{common}[relay]\n{self.options.relay}'
        )
        (self.folder / "c2.toml").write_text(
            f'[platform]\nid = "{SHORE}"\nrouter = ["{self._endpoint("router-shore")}"]\n'
            f'state_dir = "{self.shore_state}"\n{common}[c2]\nout_dir = "{self.out}"\n{self.options.c2}'
        )

    def _command(self, name: str) -> list[str]:
        prefix = list(self.options.shore_prefix) if name in ("router-shore", "c2") else []
        launch = list(self.options.launcher.get(name, (sys.executable, "-m")))
        if name == "router-vessel":
            shore = f"tcp/127.0.0.1:{self.link.port}" if self.link else self._endpoint("router-shore")
            return [*launch, "sonarpost.bus.router", "--listen", self._endpoint(name), "--connect", shore]
        if name == "router-shore":
            return [*prefix, *launch, "sonarpost.bus.router", "--listen", self._endpoint(name)]
        return [*prefix, *launch, f"sonarpost.services.{name}", "--config", str(self.folder / f"{name}.toml")]

    def start(self, name: str) -> None:
        """Start a process; its output goes to NAME.log."""
        log = (self.folder / f"{name}.log").open("ab")
        self._logs.append(log)
        environment = {
            **os.environ,
            EXIT_WITH_PARENT: str(os.getpid()),
            "OMP_NUM_THREADS": "1",
            **self.options.environment.get(name, {}),
        }
        self._processes[name] = subprocess.Popen(
            self._command(name),
            cwd=REPOSITORY,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=environment,
            process_group=0,
        )

    def pid(self, name: str) -> int:
        """Identifier of a process."""
        return self._processes[name].pid

    def kill(self, name: str) -> None:
        """End a process at once (SIGKILL)."""
        self._processes[name].kill()
        self._processes[name].wait()

    def send_signal(self, name: str, number: signal.Signals) -> None:
        """Send a process a signal."""
        self._processes[name].send_signal(number)

    def start_feeder(self, folder: str = "feeder") -> Feeder:
        """Start the outbox in the decompressor's place, on a store of its own."""
        state = self.folder / "state" / folder
        platform = PlatformConfig(
            id=VESSEL, router=(self._endpoint("router-vessel"),), state_dir=state, health_interval_s=60.0
        )
        self._feeder = Feeder(platform, ServiceConfig())
        assert self._feeder.start()
        return self._feeder

    def stop_feeder(self) -> None:
        """Stop it."""
        if self._feeder is not None:
            feeder, self._feeder = self._feeder, None
            feeder.stop()

    @property
    def feeder(self) -> Feeder:
        """The running feeder."""
        assert self._feeder is not None
        return self._feeder

    def owe(self, images: Sequence[ReconstructedImage]) -> None:
        """Owe pictures, and expect them ashore."""
        self.feeder.owe(images)
        self.expected.update(((i.vehicle_id, i.image_id, i.version), i) for i in images)

    def close(self) -> None:
        """Stop everything."""
        for watcher in self._watchers:
            watcher.close()
        self.stop_feeder()
        for name in reversed(PROCESSES):
            process = self._processes.get(name)
            if process is not None and process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self._processes.values():
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self.link is not None:
            self.link.close()
        for log in self._logs:
            log.close()

    # What is seen

    def watch_health(self) -> None:
        """Follow the health of relay and c2, each at its own router."""
        for router in ("router-vessel", "router-shore"):
            session = open_with_retry([self._endpoint(router)], threading.Event())
            assert session is not None
            self._watchers.append(session)
            session.declare_subscriber("sonarpost/v1/*/health/*", self._heard)

    def _heard(self, sample: zenoh.Sample) -> None:
        health = wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr))
        self.health[health.service] = health

    def until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait for a condition; fail with the state of everything when it does not come true."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"{what}: not within {timeout_s} s; {self.describe()}")
            time.sleep(0.02)

    def describe(self) -> str:
        """Return the state of everything, for people."""
        tails = "".join(f"\n--- {name}\n{self.log_tail(name)}" for name in PROCESSES)
        return (
            f"owed {len(self.expected)}, feeder {self.feeder.store.outbox_depth() if self._feeder else '-'}, relay "
            f"{self.depths('relay')}, c2 {self.depths('c2')}, ashore {self.ashore_count()}{tails}"
        )

    def log_tail(self, name: str, lines: int = 6) -> str:
        """Return what a process wrote last."""
        path = self.folder / f"{name}.log"
        return "\n".join(path.read_text(errors="replace").splitlines()[-lines:]) if path.is_file() else ""

    def log_text(self, name: str) -> str:
        """Return all that a process wrote."""
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def database(self, service: str) -> Path:
        """Path of a service's store."""
        return (self.vessel_state if service == "relay" else self.shore_state) / f"{service}.db"

    def ask(self, service: str, sql: str) -> int | None:
        """Return one number of a store, None while it cannot be read."""
        try:
            with contextlib.closing(sqlite3.connect(f"file:{self.database(service)}?mode=ro", uri=True)) as db:
                row = db.execute(sql).fetchone()
        except sqlite3.Error:
            return None
        return int(row[0]) if row and row[0] is not None else 0

    def depths(self, service: str) -> dict[str, int | None]:
        """Return how much lies in a store's tables."""
        return {t: self.ask(service, f"SELECT COUNT(*) FROM {t}") for t in ("inbox", "outbox", "refused", "partial")}

    def accepted(self, service: str) -> int | None:
        """Return how many records a store has ever committed to its inbox: SQLite counts them, and never back."""
        return self.ask(service, "SELECT seq FROM sqlite_sequence WHERE name = 'inbox'")

    def ashore_count(self) -> int:
        """Return how many side-cars c2 has written."""
        folder = self.out / VESSEL
        return sum(1 for p in folder.glob("*.json") if not p.name.startswith(".")) if folder.is_dir() else 0

    # The account

    def settled(self) -> bool:
        """Tell whether everything owed is ashore and nobody owes anything any more."""
        return (
            self.ashore_count() >= len(self.expected)
            and self.feeder.store.outbox_depth() == 0
            and all(self.depths(s)[t] == 0 for s in ("relay", "c2") for t in ("inbox", "outbox"))
        )

    def assert_all_ashore_once(self, timeout_s: float = 120.0, *, records: int | None = None) -> None:
        """Wait, then check: none lost, none doubled, none corrupted.

        Args:
            timeout_s: How long to wait at most.
            records: How many records c2 has committed in its life; by default as many as pictures were owed.
        """
        self.until(self.settled, timeout_s, "everything ashore")
        wanted = len(self.expected) if records is None else records
        assert self.accepted("c2") == wanted, "records committed by c2"
        assert self.depths("c2")["refused"] == self.depths("relay")["refused"] == 0
        assert self._files() == {name: image.picture_sha256 for name, image in self.expected.items()}
        assert self._rows() == Counter(dict.fromkeys(self.expected, 1))
        left = [p.name for p in self.out.rglob(".*.tmp")]
        assert left == [], "half-written files"

    def pixels_by_file(self) -> dict[Path, str]:
        """Return the sha256 of every picture's pixels by its side-car, read back from its files, both of them."""
        found: dict[Path, str] = {}
        for path in (self.out / VESSEL).glob("[!.]*.json"):
            tiff = np.ascontiguousarray(tifffile.imread(path.with_suffix(".tiff")))
            with Image.open(path.with_suffix(".png")) as png:
                assert np.array_equal(np.asarray(png), tiff), path
            found[path] = hashlib.sha256(tiff.tobytes()).hexdigest()
        return found

    def _files(self) -> dict[Name, str]:
        found: dict[Name, str] = {}
        for path, sha256 in self.pixels_by_file().items():
            side_car = json.loads(path.read_text())
            name = (side_car["vehicle_id"], side_car["image_id"], side_car["version"])
            assert name not in found, f"{name} is there twice"
            assert sha256 == side_car["picture_sha256"], path
            found[name] = sha256
        return found

    def _rows(self) -> Counter[Name]:
        with contextlib.closing(sqlite3.connect(f"file:{self.out / 'index.db'}?mode=ro", uri=True)) as db:
            rows = db.execute("SELECT vehicle_id, image_id, version FROM picture").fetchall()
        return Counter((str(v), str(i), int(n)) for v, i, n in rows)

    def wipe_vessel(self) -> None:
        """Delete the vessel's stores, the relay's and the feeder's; both must be stopped."""
        shutil.rmtree(self.vessel_state)
        shutil.rmtree(self.folder / "state" / "feeder")
