"""The contacts of a long mission through all services: memory, descriptors, threads, files, renewal of certificates.

`SONARPOST_SOAK_CONTACTS` sets the number of contacts (60; 1200 are 40 a day for 30 days). The chain is fed as fast as
it delivers; the timers of the services run in real time. `SONARPOST_SOAK_OUT` names a folder for the table and the
operation log.
"""

import hashlib
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import tifffile
from builders.common import REPOSITORY, eventually, free_port
from builders.history import History
from builders.image_archive import side_cars
from builders.numbered_snippet import number_of, numbered_snippet
from builders.progress import wait_while_progressing

from sonarpost.extensions.simulation.demo.chain import ROUTERS, Chain
from sonarpost.extensions.simulation.demo.outcome import read_images
from sonarpost.extensions.simulation.demo.settings import PLATFORM_OF, ChainSettings
from sonarpost.sonar.image_files import write_png

CONTACTS = int(os.environ.get("SONARPOST_SOAK_CONTACTS", "60"))
IN_FLIGHT = 24
SAMPLE_S = 2.0
SHORE_LIMIT_BYTES = 2_200_000
"""Limit of c2's images, about 45 contacts: retention removes older ones during the run, none that is in flight."""
MAX_GROWTH_MB = 40.0
"""Growth of a process from a quarter of the contacts to the end."""


@dataclass(frozen=True)
class ProcessSample:
    """One process at one time.

    Attributes:
        contacts: Contacts delivered so far.
        rss_mb: Resident memory in MB.
        descriptors: Open file descriptors.
        threads: Threads.
    """

    contacts: int
    rss_mb: float
    descriptors: int
    threads: int


def sample_process(pid: int, contacts: int) -> ProcessSample:
    """Return a sample of a running process."""
    status = dict(
        line.split(":", 1)
        for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
        if ":" in line
    )
    descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    return ProcessSample(contacts, int(status["VmRSS"].split()[0]) / 1024, descriptors, int(status["Threads"]))


def folder_bytes(paths: Iterable[Path]) -> int:
    """Return the size of all files below some folders, or of files."""
    total = 0
    for path in paths:
        for file in path.rglob("*") if path.is_dir() else (path,):
            try:
                total += file.stat().st_size if file.is_file() else 0
            except FileNotFoundError:
                continue  # removed since it was listed
    return total


class Samples:
    """Samples of all processes and folders of a chain.

    Args:
        chain: The running chain.
        folders: Files and folders by the name of their row in the table.
    """

    def __init__(self, chain: Chain, folders: dict[str, list[Path]]) -> None:
        self._chain = chain
        self._folders = folders
        self.processes: dict[str, list[ProcessSample]] = {}
        self.sizes: dict[str, list[tuple[int, int]]] = {}

    def take(self, contacts: int) -> None:
        """Sample every process that runs, and every folder."""
        for name in self._chain.names:
            if self._chain.status(name) is None:
                self.processes.setdefault(name, []).append(sample_process(self._chain.pid(name), contacts))
        for name, paths in self._folders.items():
            self.sizes.setdefault(name, []).append((contacts, folder_bytes(paths)))

    @staticmethod
    def nearest(samples: list[ProcessSample], contacts: float) -> ProcessSample:
        """Return the sample that is nearest to a number of contacts."""
        return min(samples, key=lambda sample: abs(sample.contacts - contacts))

    @staticmethod
    def growth(points: list[tuple[int, float]], first: float) -> float:
        """Return the slope for 1,000 contacts of the points from `first` contacts on, by linear regression."""
        late = [(x, y) for x, y in points if x >= first]
        if len({x for x, _ in late}) < 2:
            return 0.0
        x, y = np.array(late, dtype=float).T
        return float(1000.0 * np.polyfit(x, y, 1)[0])

    def table(self, contacts: int) -> str:
        """Return two Markdown tables: processes (descriptors and threads at 25 and 100 %), and files."""
        quarter, late = contacts / 4, 0.6 * contacts
        lines = [
            "| process | MB at 25, 50, 75, 100 % | MB per 1,000 contacts, from 60 % on | descriptors | threads |",
            "|---|---|---|---|---|",
        ]
        for name, samples in self.processes.items():
            at = [self.nearest(samples, quarter * part) for part in (1, 2, 3, 4)]
            growth = self.growth([(s.contacts, s.rss_mb) for s in samples], late)
            memory = ", ".join(f"{sample.rss_mb:.0f}" for sample in at)
            lines.append(
                f"| {name} | {memory} | {growth:+.1f} | {at[0].descriptors}, {at[3].descriptors} "
                f"| {at[0].threads}, {at[3].threads} |"
            )
        lines += ["", "| files | kB at 25, 50, 75, 100 % | kB per 1,000 contacts, from 60 % on |", "|---|---|---|"]
        for name, points in self.sizes.items():
            at_bytes = [min(points, key=lambda p, x=quarter * part: abs(p[0] - x))[1] for part in (1, 2, 3, 4)]
            growth = self.growth([(x, y / 1000) for x, y in points], late)
            sizes = ", ".join(f"{size / 1000:.0f}" for size in at_bytes)
            lines.append(f"| {name} | {sizes} | {growth:+.0f} |")
        return "\n".join(lines)


class TlsChain(Chain):
    """A chain whose vessel and shore routers are linked by TLS, with certificates made by `sonarpost pki`."""

    def __init__(self, settings):
        super().__init__(settings)
        self.tls_port = free_port()
        self.fleet = settings.folder / "fleet"

    def tls_folder(self, platform):
        """Folder of the certificate that the router of a platform uses."""
        return self.settings.folder / "tls" / platform

    def make_certificates(self):
        """Make the fleet, as docs/how-to/certificates.md describes."""
        self.settings.folder.mkdir(parents=True, exist_ok=True)
        pki(self.fleet, "init", "--fleet", "north")
        pki(self.fleet, "issue", "shore-1", "--role", "shore", "--host", "localhost")
        pki(self.fleet, "issue", "vessel-1", "--role", "vessel")
        _, vessel, shore = self.settings.router_ports
        endpoint = f"tls/localhost:{self.tls_port}"
        for platform, local, link in (("shore-1", shore, "--listen"), ("vessel-1", vessel, "--connect")):
            files = self.tls_folder(platform)
            shutil.copytree(self.fleet / "issued" / platform, files)
            pki(
                self.fleet,
                *("router-config", "--platform", platform, "--local", f"tcp/127.0.0.1:{local}", link, endpoint),
                *("--files", str(files), "--out", str(self.settings.folder / f"router-{platform}.json5")),
            )

    def renew_certificates(self):
        """Renew both certificates, copy them, and restart the routers."""
        for platform in ("shore-1", "vessel-1"):
            pki(self.fleet, "renew", platform)
            for file in (self.fleet / "issued" / f"{platform}.renewal-1").iterdir():
                shutil.copy2(file, self.tls_folder(platform) / file.name)
        for router in ("router-shore", "router-vessel"):
            os.kill(self.pid(router), signal.SIGTERM)
            eventually(lambda router=router: self.status(router) is not None, what=f"end of {router}")
            self.start(router)

    def command(self, name):
        platform = {"router-shore": "shore-1", "router-vessel": "vessel-1"}.get(name)
        if platform is None:
            return super().command(name)
        config = self.settings.folder / f"router-{platform}.json5"
        return [sys.executable, "-m", "sonarpost.bus.router", "--config", str(config)]

    def served_certificate(self):
        """Return the certificate with which the shore's router answers the vessel, DER."""
        files = self.tls_folder("vessel-1")
        context = ssl.create_default_context(cafile=str(files / "ca.pem"))
        context.load_cert_chain(files / "certificate.pem", files / "key.pem")
        with (
            socket.create_connection(("localhost", self.tls_port), timeout=120) as plain,
            context.wrap_socket(plain, server_hostname="localhost") as secured,
        ):
            return secured.getpeercert(binary_form=True)


def pki(fleet, *arguments):
    """Run `sonarpost pki`."""
    command = [sys.executable, "-m", "sonarpost.cli.main", "pki", arguments[0], "--dir", str(fleet), *arguments[1:]]
    subprocess.run(command, cwd=REPOSITORY, check=True, capture_output=True)


class Mission:
    """Feeds numbered snippets to the vehicle, and logs each complete image at the shore before retention removes it."""

    def __init__(self, settings, history):
        self.settings = settings
        self.history = history
        self.queued = 0
        self._found = {}
        for consumer in ("decompressor", "c2"):
            history.add("consumer", consumer)

    @property
    def delivered(self):
        """Number of complete images at the shore site."""
        return len(self._found)

    def feed(self):
        """Put snippets into the vehicle's folder; at most `IN_FLIGHT` are not yet delivered."""
        while self.queued < CONTACTS and self.queued - self.delivered < IN_FLIGHT:
            name = f"snippet-{self.queued:05}.png"
            hidden = self.settings.incoming / f".{name}"
            write_png(hidden, numbered_snippet(self.queued))
            hidden.rename(hidden.with_name(name))
            self.history.add("queued", "survey folder", f"snippet-{self.queued:05}")
            self.queued += 1

    def look(self):
        """Log the images that are complete at the shore and were not seen before."""
        for path in side_cars(self.settings.shore_images):
            base = path.stem.rpartition("_v")[0]
            if base in self._found:
                continue
            try:
                if '"complete": true' not in path.read_text(encoding="utf-8"):
                    continue
            except FileNotFoundError:
                continue  # a superseded version, which retention has removed
            tiff = path.with_suffix(".tiff")
            number = number_of(tifffile.imread(tiff))
            record = f"unreadable {path.stem}" if number is None else f"snippet-{number:05}"
            sha256 = hashlib.sha256(tiff.read_bytes()).hexdigest()
            self.history.add("handled", "c2", record, sha256=sha256, detail=path.stem)
            self._found[base] = record, path.stem

    def log_vessel_images(self):
        """Log the images of the vessel in the versions that were logged at the shore; others are unknown there."""
        stored = read_images(self.settings.vessel_images)
        for base in {name.rpartition("_v")[0] for name in stored}:
            record, name = self._found.get(base, (f"not at the shore {base}", ""))
            if name in stored:
                self.history.add("handled", "decompressor", record, sha256=stored[name].sha256, detail=name)
            elif not name:
                self.history.add("handled", "decompressor", record, detail=base)


@pytest.mark.timeout(1800 + 4 * CONTACTS)
def test_services_neither_grow_nor_lose_a_contact_over_a_long_mission(tmp_path):
    settings = ChainSettings(
        folder=tmp_path / "run",
        mode="snippets",
        rate=5,
        loss=0.05,
        time_scale=100.0,
        router_ports=(free_port(), free_port(), free_port()),
        extra=(
            ("c2", f"max_bytes = {SHORE_LIMIT_BYTES}"),
            ("op_modem", "max_images_per_hour = 1000000\nmax_image_bytes_per_hour = 1099511627776"),
        ),
    )
    history = History(settings.folder / "history.jsonl")
    chain = TlsChain(settings)
    chain.make_certificates()
    with chain:
        folders = {}
        for service, platform in PLATFORM_OF.items():
            store = settings.folder / "state" / platform / f"{service}.db"
            folders[f"store of {service}"] = [store, store.with_name(f"{store.name}-wal")]
        folders["images of the vessel"] = [settings.vessel_images]
        folders["images of the shore site"] = [settings.shore_images]
        folders["archive of the shore site"] = [settings.shore_images.parent / "archive.db"]
        folders["logs"] = [settings.folder / "logs"]
        samples = Samples(chain, folders)
        mission = Mission(settings, history)
        stores = [path[0] for path in folders.values() if path[0].suffix == ".db"]
        eventually(lambda: chain.check() is None and all(store.is_file() for store in stores), what="stores")
        served = chain.served_certificate()
        started_s = time.monotonic()
        sample_s, renewed = 0.0, False

        def delivered():
            nonlocal sample_s, renewed
            chain.check()
            mission.feed()
            mission.look()
            if time.monotonic() - sample_s > SAMPLE_S:
                samples.take(mission.delivered)
                sample_s = time.monotonic()
            if not renewed and mission.delivered >= CONTACTS // 2:
                history.fault("routers", "certificates renewed, restarted")
                chain.renew_certificates()
                renewed = True
            return mission.delivered >= CONTACTS

        wait_while_progressing(delivered, lambda: mission.delivered, "contacts", lambda: mission.delivered)
        elapsed_s = time.monotonic() - started_s
        samples.take(mission.delivered)
        assert chain.served_certificate() != served, "the shore's router uses the renewed certificate"
    mission.log_vessel_images()
    history.close()
    verdict = history.verdict()
    text = f"{CONTACTS} contacts in {elapsed_s:.0f} s\n{verdict}\n\n{samples.table(CONTACTS)}\n"
    print(text)
    if (out := os.environ.get("SONARPOST_SOAK_OUT")) is not None:
        Path(out).mkdir(parents=True, exist_ok=True)
        (Path(out) / "soak.md").write_text(text)
        shutil.copy(history.path, Path(out) / "soak-history.jsonl")
    assert verdict.ok, verdict
    assert samples.sizes["images of the shore site"][-1][1] < 1.5 * SHORE_LIMIT_BYTES, "retention limits the images"
    for name, taken in samples.processes.items():
        early, last = samples.nearest(taken, CONTACTS / 4), taken[-1]
        assert last.rss_mb < early.rss_mb + MAX_GROWTH_MB, name
        assert last.descriptors <= early.descriptors + 8, name
        assert last.threads <= early.threads + 8, name
    assert set(samples.processes) == {*ROUTERS, *PLATFORM_OF}
