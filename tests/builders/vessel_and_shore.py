"""A vessel and a shore site in real processes, the link between them, and the operation log of the run.

Both routers, relay and c2 are processes with their own stores. The test replaces the decompressor: its outbox sends
`image/coded` to the relay.
"""

import contextlib
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from builders.common import REPOSITORY, WAIT_S, free_port
from builders.history import History
from builders.image_archive import ArchiveLog, name_of, side_cars
from builders.image_source import VESSEL, ImageSource, pixels_sha256
from builders.progress import wait_while_progressing
from research.common.link_emulator import LinkEmulator
from sonarpost import keys, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.config import PlatformConfig
from sonarpost.messages import Health, ReconstructedImage
from sonarpost.stop_signals import EXIT_WITH_PARENT

SHORE = "shore-1"
PROCESSES = ("router-vessel", "router-shore", "relay", "c2")
KEY = keys.image_coded(VESSEL)
UNFINISHED = ("inbox", "outbox")
"""Rows of a store for records that are not handled or not acknowledged."""


@dataclass
class Options:
    """Options of the system.

    Attributes:
        link_bytes_per_s: Bandwidth of the link in each direction.
        relay, c2: Additional lines for their tables.
        vessel_state, shore_state, shore_out: Folders, by default below the folder of the system.
        environment: Additional environment variables, by process.
        shore_prefix: Command that runs the processes of the shore, for example in another network namespace.
        shore_host: Address of the shore's router; for another host there is no LinkEmulator.
    """

    link_bytes_per_s: float | None = None
    relay: str = ""
    c2: str = ""
    vessel_state: Path | None = None
    shore_state: Path | None = None
    shore_out: Path | None = None
    environment: dict[str, dict[str, str]] = field(default_factory=dict)
    shore_prefix: Sequence[str] = ()
    shore_host: str = "127.0.0.1"


class VesselAndShore:
    """Processes of a vessel and a shore; a context manager that stops all of them.

    Attributes:
        history: Operation log of the run, in history.jsonl of the folder.
        expected: Identities of the images that were sent.
    """

    def __init__(self, folder, options=None):
        self.folder = folder
        self.options = options or Options()
        self.vessel_state = self.options.vessel_state or folder / "state" / VESSEL
        self.shore_state = self.options.shore_state or folder / "state" / SHORE
        self.out = self.options.shore_out or folder / "out"
        self.ports = {"router-vessel": free_port(), "router-shore": free_port()}
        self.link = None
        self.expected = set()
        self.history = History(folder / "history.jsonl")
        self._accepted = 0
        self._archive_log = ArchiveLog(self.history, self.out, VESSEL, KEY)
        self._processes = {}
        self._logs = []
        self._source = None
        self._watchers = []
        self.health = {}

    def __enter__(self):
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.options.shore_host == "127.0.0.1":
            self.link = LinkEmulator(
                self.ports["router-shore"],
                rate_bytes_per_s=self.options.link_bytes_per_s,
                on_fault=lambda fault: self.history.fault("link", fault),
            )
        self._write_config()
        for consumer in ("c2", "c2 index"):
            self.history.add("consumer", consumer)
        self.history.add("consumer", "subscriber", delivery="any", ordered=True)
        try:
            for name in PROCESSES:
                self.start(name)
            self.start_source()
            self._watch_images()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_):
        self.close()

    # Processes

    def _endpoint(self, router):
        host = self.options.shore_host if router == "router-shore" else "127.0.0.1"
        return f"tcp/{host}:{self.ports[router]}"

    def _write_config(self):
        common = "health_interval_s = 0.2\n"
        (self.folder / "relay.toml").write_text(
            f'[platform]\nid = "{VESSEL}"\nrouter = ["{self._endpoint("router-vessel")}"]\n'
            f'state_dir = "{self.vessel_state}"\n{common}[relay]\n{self.options.relay}'
        )
        (self.folder / "c2.toml").write_text(
            f'[platform]\nid = "{SHORE}"\nrouter = ["{self._endpoint("router-shore")}"]\n'
            f'state_dir = "{self.shore_state}"\n{common}[c2]\nout_dir = "{self.out}"\n{self.options.c2}'
        )

    def _command(self, name):
        prefix = list(self.options.shore_prefix) if name in ("router-shore", "c2") else []
        launch = [*prefix, sys.executable, "-m"]
        if name == "router-vessel":
            shore = f"tcp/127.0.0.1:{self.link.port}" if self.link else self._endpoint("router-shore")
            return [*launch, "sonarpost.bus.router", "--listen", self._endpoint(name), "--connect", shore]
        if name == "router-shore":
            return [*launch, "sonarpost.bus.router", "--listen", self._endpoint(name)]
        return [*launch, f"sonarpost.services.{name}", "--config", str(self.folder / f"{name}.toml")]

    def start(self, name):
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

    def pid(self, name):
        return self._processes[name].pid

    def kill(self, name):
        """End a process at once (SIGKILL)."""
        self.history.fault(name, "SIGKILL")
        self._processes[name].kill()
        self._processes[name].wait()

    def send_signal(self, name, number):
        self.history.fault(name, number.name)
        self._processes[name].send_signal(number)

    def start_source(self):
        """Start the outbox of the test, with its own store."""
        platform = PlatformConfig(
            id=VESSEL,
            router=(self._endpoint("router-vessel"),),
            state_dir=self.folder / "state" / "source",
            health_interval_s=60.0,
        )
        self._source = ImageSource(platform, lambda image: self._log("acknowledged", "relay", image))
        assert self._source.start()
        return self._source

    def stop_source(self):
        if self._source is not None:
            source, self._source = self._source, None
            source.stop()

    @property
    def source(self):
        assert self._source is not None
        return self._source

    def send(self, images):
        """Send images, which are then expected at the shore. An image may be sent again."""
        self.source.send(images)
        for image in images:
            self._log("queued", "source", image)
        self.expected.update(map(name_of, images))

    def _log(self, operation, process, image):
        self.history.add(operation, process, name_of(image), key=KEY, sha256=pixels_sha256(image))

    def close(self):
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
                process.wait(timeout=WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self.link is not None:
            self.link.close()
        self.history.close()
        for log in self._logs:
            log.close()

    # Observation

    def _watch_images(self):
        session = open_with_retry([self._endpoint("router-shore")], threading.Event())
        assert session is not None
        self._watchers.append(session)
        session.declare_subscriber(keys.shore_image(VESSEL), self._on_image)

    def _on_image(self, sample):
        image = wire.decode(ReconstructedImage, sample.payload.to_bytes(), str(sample.key_expr))
        self.history.add("seen", "subscriber", name_of(image), key=KEY, sha256=image.pixels_sha256)

    def wait_for_state(self, service, state, detail=""):
        """Wait until relay or c2 reports a state, and a detail that contains a pattern; needs `watch_health`."""

        def reports():
            health = self.health.get(service)
            return health is not None and health.state == state and re.search(detail, health.detail) is not None

        self.wait_until(reports, f"{service} reports {state} {detail}")

    def watch_health(self):
        """Subscribe to the health of relay and c2, each at its own router."""
        for router in ("router-vessel", "router-shore"):
            session = open_with_retry([self._endpoint(router)], threading.Event())
            assert session is not None
            self._watchers.append(session)
            session.declare_subscriber("sonarpost/v1/*/health/*", self._on_health)

    def _on_health(self, sample):
        health = wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr))
        self.health[health.service] = health

    def wait_until(self, condition, what):
        """Wait for a condition; fail with the state of all processes when no count changes."""
        wait_while_progressing(condition, self._progress, what, self.describe)

    def _progress(self):
        stores = [self.depths(service) for service in ("relay", "c2")]
        outbox = self._source.store.outbox_depth() if self._source else 0
        return stores, self.accepted_count("c2"), outbox, self.shore_image_count()

    def describe(self):
        tails = "".join(f"\n--- {name}\n{self.log_tail(name)}" for name in PROCESSES)
        return (
            f"sent {len(self.expected)}, source {self.source.store.outbox_depth() if self._source else '-'}, relay "
            f"{self.depths('relay')}, c2 {self.depths('c2')}, at the shore {self.shore_image_count()}{tails}"
        )

    def log_tail(self, name, lines=6):
        return "\n".join(self.log_text(name).splitlines()[-lines:]) if name in self._processes else ""

    def log_text(self, name):
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def database(self, service):
        """Return the store of a service, or the archive of c2."""
        folders = {"relay": self.vessel_state, "archive": self.out}
        return folders.get(service, self.shore_state) / f"{service}.db"

    def query(self, service, sql):
        """Return one number of a store, None while it cannot be read."""
        try:
            with contextlib.closing(sqlite3.connect(f"file:{self.database(service)}?mode=ro", uri=True)) as db:
                row = db.execute(sql).fetchone()
        except sqlite3.Error:
            return None
        return int(row[0]) if row and row[0] is not None else 0

    def depths(self, service):
        return {t: self.query(service, f"SELECT COUNT(*) FROM {t}") for t in ("inbox", "outbox", "refused", "partial")}

    def accepted_count(self, service):
        """Return the number of records ever committed to an inbox, from SQLite's autoincrement counter."""
        return self.query(service, "SELECT seq FROM sqlite_sequence WHERE name = 'inbox'")

    def shore_image_count(self):
        """Return the number of side-cars that c2 has written."""
        return len(side_cars(self.out / VESSEL))

    # Account

    def is_complete(self):
        """Return whether all sent images are at the shore and all stores are empty."""
        return (
            self.shore_image_count() >= len(self.expected)
            and self.source.store.outbox_depth() == 0
            and all(self.query(s, f"SELECT COUNT(*) FROM {rows}") == 0 for s in ("relay", "c2") for rows in UNFINISHED)
            and self.query("archive", "SELECT COUNT(*) FROM backlog") == 0
        )

    def assert_all_delivered_once(self):
        """Wait until all images are delivered, then let the checker of the operation log decide."""
        self.wait_until(self.is_complete, "all images at the shore")
        assert self.depths("c2")["refused"] == self.depths("relay")["refused"] == 0
        self._archive_log.update()
        accepted = self.accepted_count("c2")
        assert accepted is not None
        self.history.add("accepted", "c2", count=accepted - self._accepted)
        self._accepted = accepted
        verdict = self.history.verdict()
        assert verdict.ok, f"{self.history.path}: {verdict}"
        left = [p.name for p in self.out.rglob(".*.tmp")]
        assert left == [], "temporary files"

    def delete_vessel_stores(self):
        """Delete the stores of relay and source, which must be stopped."""
        shutil.rmtree(self.vessel_state)
        shutil.rmtree(self.folder / "state" / "source")
