"""A vessel and a shore site in real processes, the link between them, and an exact account of the delivered images.

Both routers, relay and c2 are processes with their own stores. The test replaces the decompressor: its outbox sends
`image/reconstructed` to the relay.
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
from builders.image_source import VESSEL, ImageSource
from sonarpost import wire
from sonarpost.bus.session import open_with_retry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Health, ReconstructedImage
from sonarpost.stop_signals import EXIT_WITH_PARENT

SHORE = "shore-1"
PROCESSES = ("router-vessel", "router-shore", "relay", "c2")
Name = tuple[str, str, int]


@dataclass
class Options:
    """Options of the system.

    Attributes:
        link_bytes_per_s: Bandwidth of the link in each direction.
        relay, c2: Additional lines for their tables.
        vessel_state, shore_state, shore_out: Folders, by default below the folder of the system.
        launcher: Command that runs a module, by process; by default the interpreter.
        environment: Additional environment variables, by process.
        shore_prefix: Command that runs the processes of the shore, for example in another network namespace.
        shore_host: Address of the shore's router; for another host there is no FaultyLink.
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


class VesselAndShore:
    """Processes of a vessel and a shore; a context manager that stops all of them."""

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
        self._source: ImageSource | None = None
        self._watchers: list[zenoh.Session] = []
        self.health: dict[str, Health] = {}

    def __enter__(self) -> VesselAndShore:
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.options.shore_host == "127.0.0.1":
            self.link = FaultyLink(self.ports["router-shore"], self.options.link_bytes_per_s)
        self._write_config()
        try:
            for name in PROCESSES:
                self.start(name)
            self.start_source()
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

    def start_source(self, folder: str = "source") -> ImageSource:
        """Start the outbox of the test, with its own store."""
        state = self.folder / "state" / folder
        platform = PlatformConfig(
            id=VESSEL, router=(self._endpoint("router-vessel"),), state_dir=state, health_interval_s=60.0
        )
        self._source = ImageSource(platform, ServiceConfig())
        assert self._source.start()
        return self._source

    def stop_source(self) -> None:
        """Stop the outbox of the test."""
        if self._source is not None:
            source, self._source = self._source, None
            source.stop()

    @property
    def source(self) -> ImageSource:
        """The running outbox of the test."""
        assert self._source is not None
        return self._source

    def send(self, images: Sequence[ReconstructedImage]) -> None:
        """Send images, which are then expected at the shore."""
        self.source.send(images)
        self.expected.update(((i.vehicle_id, i.image_id, i.version), i) for i in images)

    def close(self) -> None:
        """Stop everything."""
        for watcher in self._watchers:
            watcher.close()
        self.stop_source()
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

    # Observation

    def watch_health(self) -> None:
        """Subscribe to the health of relay and c2, each at its own router."""
        for router in ("router-vessel", "router-shore"):
            session = open_with_retry([self._endpoint(router)], threading.Event())
            assert session is not None
            self._watchers.append(session)
            session.declare_subscriber("sonarpost/v1/*/health/*", self._on_health)

    def _on_health(self, sample: zenoh.Sample) -> None:
        health = wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr))
        self.health[health.service] = health

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait for a condition; fail with the state of all processes after the time-out."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"{what}: not within {timeout_s} s; {self.describe()}")
            time.sleep(0.02)

    def describe(self) -> str:
        """Return the state of all processes as text."""
        tails = "".join(f"\n--- {name}\n{self.log_tail(name)}" for name in PROCESSES)
        return (
            f"sent {len(self.expected)}, source {self.source.store.outbox_depth() if self._source else '-'}, relay "
            f"{self.depths('relay')}, c2 {self.depths('c2')}, at the shore {self.shore_image_count()}{tails}"
        )

    def log_tail(self, name: str, lines: int = 6) -> str:
        """Return the last lines of a process's log."""
        path = self.folder / f"{name}.log"
        return "\n".join(path.read_text(errors="replace").splitlines()[-lines:]) if path.is_file() else ""

    def log_text(self, name: str) -> str:
        """Return the log of a process."""
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def database(self, service: str) -> Path:
        """Path of a service's store."""
        return (self.vessel_state if service == "relay" else self.shore_state) / f"{service}.db"

    def query(self, service: str, sql: str) -> int | None:
        """Return one number of a store, None while it cannot be read."""
        try:
            with contextlib.closing(sqlite3.connect(f"file:{self.database(service)}?mode=ro", uri=True)) as db:
                row = db.execute(sql).fetchone()
        except sqlite3.Error:
            return None
        return int(row[0]) if row and row[0] is not None else 0

    def depths(self, service: str) -> dict[str, int | None]:
        """Return the number of rows in a store's tables."""
        return {t: self.query(service, f"SELECT COUNT(*) FROM {t}") for t in ("inbox", "outbox", "refused", "partial")}

    def accepted_count(self, service: str) -> int | None:
        """Return the number of records ever committed to an inbox, from SQLite's autoincrement counter."""
        return self.query(service, "SELECT seq FROM sqlite_sequence WHERE name = 'inbox'")

    def shore_image_count(self) -> int:
        """Return the number of side-cars that c2 has written."""
        folder = self.out / VESSEL
        return sum(1 for p in folder.glob("*.json") if not p.name.startswith(".")) if folder.is_dir() else 0

    # Account

    def is_complete(self) -> bool:
        """Return whether all sent images are at the shore and all stores are empty."""
        return (
            self.shore_image_count() >= len(self.expected)
            and self.source.store.outbox_depth() == 0
            and all(self.depths(s)[t] == 0 for s in ("relay", "c2") for t in ("inbox", "outbox"))
        )

    def assert_all_delivered_once(self, timeout_s: float = 120.0, *, records: int | None = None) -> None:
        """Wait until all images are delivered, then check that none is lost, duplicated or corrupted.

        Args:
            timeout_s: Maximum wait.
            records: Number of records that c2 has committed in total; by default the number of sent images.
        """
        self.wait_until(self.is_complete, timeout_s, "all images at the shore")
        wanted = len(self.expected) if records is None else records
        assert self.accepted_count("c2") == wanted, "records committed by c2"
        assert self.depths("c2")["refused"] == self.depths("relay")["refused"] == 0
        assert self._files() == {name: image.picture_sha256 for name, image in self.expected.items()}
        assert self._rows() == Counter(dict.fromkeys(self.expected, 1))
        left = [p.name for p in self.out.rglob(".*.tmp")]
        assert left == [], "temporary files"

    def pixels_by_file(self) -> dict[Path, str]:
        """Return the SHA-256 of each image's pixels by side-car, read from its TIFF and PNG files."""
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
            assert name not in found, f"{name} is stored twice"
            assert sha256 == side_car["picture_sha256"], path
            found[name] = sha256
        return found

    def _rows(self) -> Counter[Name]:
        with contextlib.closing(sqlite3.connect(f"file:{self.out / 'index.db'}?mode=ro", uri=True)) as db:
            rows = db.execute("SELECT vehicle_id, image_id, version FROM picture").fetchall()
        return Counter((str(v), str(i), int(n)) for v, i, n in rows)

    def delete_vessel_stores(self) -> None:
        """Delete the stores of relay and source, which must be stopped."""
        shutil.rmtree(self.vessel_state)
        shutil.rmtree(self.folder / "state" / "source")
