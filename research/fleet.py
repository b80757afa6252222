"""`python -m research.fleet`: many vehicles over several vessels into one shore site, on one host.

    python -m research.fleet [--vehicles 100] [--vessels 4] [--seconds 600] [--every 10] [--grow 10,30] [--dir DIR]

Real processes, each with its own store: a router and a relay for each vessel, the router of the shore site, and c2,
which writes the files of every image. Vehicles, acoustic channel and decompressor are replaced by one load process a
vessel: it queues a reconstructed image of 300 x 100 px for the relay in its durable outbox, for each of its vehicles
once every `--every` seconds at a random phase. All processes run on this host and share one clock. The latency of an
image is the time from queueing it, before it is written to disk, until a subscriber at the shore site receives it from
c2, after c2 has written its files.

Each run prints one JSON object, including the load average of the host (mean of samples of the one-minute average) and
the CPU usage of all processes of the host and of this benchmark. The exit status is 0 if every image arrived once at
the shore site with the correct sha256.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import msgpack
import numpy as np
import zenoh

from sonarpost import keys
from sonarpost.archive.shore_index import ShoreIndex
from sonarpost.bus.session import client_config
from sonarpost.cli.demo.settings import free_ports
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Pixels, ReconstructedImage, Record
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.stop_signals import EXIT_WITH_PARENT

DRAIN_TIMEOUT_S = 120.0
SAMPLE_S = 5.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
SHAPE = (100, 300)
"""Height and width in pixels: 30 kB."""


class Load(Service[ServiceConfig]):
    """Load of one vessel: an outbox with reconstructed images."""

    NAME = "load"
    PUBLISH = False

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """No records are consumed."""
        raise NotImplementedError


def noise_image(
    vessel_id: str, vehicle_id: str, image_id: str, seed: int | Sequence[int], first_frame_utc_s: float
) -> ReconstructedImage:
    """Return a completely received image of noise, which is not compressible; the same seed gives the same pixels."""
    pixels = Pixels.from_array(np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8))
    return ReconstructedImage(
        vessel_id=vessel_id,
        vehicle_id=vehicle_id,
        image_id=image_id,
        version=1,
        contact=None,
        codec="vq",
        model="",
        picture=pixels,
        picture_sha256=pixels.sha256,
        complete=True,
        missing_fraction=0.0,
        missing_mask=b"",
        missing_halves=(),
        bytes_received=232,
        bytes_total=232,
        frames_received=6,
        first_frame_utc_s=first_frame_utc_s,
        last_frame_utc_s=first_frame_utc_s,
    )


def new_image(vessel: str, vehicle: int, number: int, now_utc_s: float) -> ReconstructedImage:
    """Return an image of noise, 30 kB, different for every vehicle and number."""
    return noise_image(vessel, f"uuv-{vehicle}", f"{number:04X}", [vehicle, number], now_utc_s)


def run_load(endpoint: str, folder: Path, vessel: str, vehicles: Sequence[int], seconds: float, every_s: float) -> None:
    """Queue images for a time, then wait until the relay has accepted them; print their number."""
    platform = PlatformConfig(id=vessel, router=(endpoint,), state_dir=folder / vessel, health_interval_s=60.0)
    load = Load(platform, ServiceConfig())
    load.start()
    rng = random.Random(vehicles[0])
    started_s = time.monotonic()
    due = sorted((rng.uniform(0, every_s) + n * every_s, v, n) for v in vehicles for n in range(int(seconds / every_s)))
    for at_s, vehicle, number in due:
        load.stopping.wait(max(0.0, started_s + at_s - time.monotonic()))
        effects = UnitOfWork()
        effects.send(
            keys.image_reconstructed(vessel), "relay", new_image(vessel, vehicle, number, time.time()), priority=5
        )
        load.commit(effects)
    ends_s = time.monotonic() + DRAIN_TIMEOUT_S
    while load.store.outbox_depth() and time.monotonic() < ends_s:
        load.stopping.wait(0.1)
    print(len(due), flush=True)
    load.stop()


@dataclass
class ReceivedImages:
    """Images received by a subscriber at the shore site.

    Attributes:
        latency_s: Latency of the first reception, by image.
        wrong: Number of images with a wrong sha256.
        again: Number of repeated images.
        lock: Protects the other attributes.
    """

    latency_s: dict[tuple[str, str, float], float] = field(default_factory=dict)
    wrong: int = 0
    again: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def receive(self, sample: zenoh.Sample) -> None:
        """Record an image."""
        now_utc_s = time.time()
        image = msgpack.unpackb(sample.payload.to_bytes())  # not validated: this process shares cores with c2
        name = (image["vehicle_id"], image["image_id"], image["first_frame_utc_s"])
        with self.lock:
            if hashlib.sha256(image["picture"]["data"]).hexdigest() != image["picture_sha256"]:
                self.wrong += 1
            if name in self.latency_s:
                self.again += 1
            else:
                self.latency_s[name] = now_utc_s - image["last_frame_utc_s"]


class HostLoad:
    """Load of the whole host: samples of its load average, and its CPU time."""

    def __init__(self) -> None:
        self._samples: list[float] = []
        self._stop = threading.Event()
        self._busy_s, self._total_s = self._cpu_s()
        self._own_s = sum(os.times()[:4])
        self._thread = threading.Thread(target=self._sample, name="host-load", daemon=True)
        self._thread.start()

    @staticmethod
    def _cpu_s() -> tuple[float, float]:
        """Return busy and total CPU time of the host since it started."""
        fields = [int(value) for value in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        idle = fields[3] + fields[4]
        return (sum(fields) - idle) / TICKS_PER_S, sum(fields) / TICKS_PER_S

    def _sample(self) -> None:
        while not self._stop.is_set():
            self._samples.append(os.getloadavg()[0])
            self._stop.wait(SAMPLE_S)

    def stop(self, services_s: float) -> dict[str, float]:
        """Return load average (mean, maximum) and CPU usage (percent of all cores) since the start.

        Args:
            services_s: CPU time of the services; this process and the load processes are added.
        """
        self._stop.set()
        self._thread.join()
        busy_s, total_s = self._cpu_s()
        own_s = services_s + sum(os.times()[:4]) - self._own_s
        return {
            "load_mean": round(sum(self._samples) / len(self._samples), 1),
            "load_max": round(max(self._samples), 1),
            "host_cpu_percent": round(100 * (busy_s - self._busy_s) / (total_s - self._total_s), 1),
            "own_cpu_percent": round(100 * own_s / (total_s - self._total_s), 1),
        }


class Processes:
    """The processes of one run, with their CPU time and memory."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.running: dict[str, subprocess.Popen[str]] = {}

    def start(self, name: str, *command: str) -> None:
        """Start a process of this interpreter with a log file."""
        environment = {**os.environ, EXIT_WITH_PARENT: str(os.getpid()), "OMP_NUM_THREADS": "1"}
        with (self._folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(
                [sys.executable, *command], stdout=subprocess.PIPE, stderr=log, text=True, env=environment
            )

    def cpu_s(self, name: str) -> float:
        """Return user and system CPU time of a process."""
        stat = Path(f"/proc/{self.running[name].pid}/stat").read_text()
        fields = stat.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS_PER_S

    def rss_mb(self, name: str) -> float:
        """Return the resident memory of a process, MB."""
        status = Path(f"/proc/{self.running[name].pid}/status").read_text()
        [line] = [text for text in status.splitlines() if text.startswith("VmRSS")]
        return int(line.split()[1]) / 1024

    def stop(self) -> None:
        """Stop all processes."""
        for process in reversed(self.running.values()):
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self.running.values():
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


@contextmanager
def fleet(folder: Path, vessels: Sequence[str]) -> Iterator[tuple[Processes, dict[str, str], str]]:
    """Start routers, relays and c2; yield the processes, the endpoint of each vessel, and that of the shore site."""
    ports = free_ports(len(vessels) + 1)
    shore = f"tcp/127.0.0.1:{ports[0]}"
    endpoints = {vessel: f"tcp/127.0.0.1:{port}" for vessel, port in zip(vessels, ports[1:], strict=True)}
    processes = Processes(folder)
    (folder / "shore.toml").write_text(
        f'[platform]\nid = "shore-1"\nrouter = ["{shore}"]\nstate_dir = "{folder / "shore"}"\n[c2]\n'
        f'out_dir = "{folder / "out"}"\n'
    )
    try:
        processes.start("router-shore", "-m", "sonarpost.bus.router", "--listen", shore)
        processes.start("c2", "-m", "sonarpost.services.c2", "--config", str(folder / "shore.toml"))
        for vessel, endpoint in endpoints.items():
            file = folder / f"{vessel}.toml"
            file.write_text(
                f'[platform]\nid = "{vessel}"\nrouter = ["{endpoint}"]\nstate_dir = "{folder / vessel}"\n[relay]\n'
            )
            processes.start(f"router-{vessel}", "-m", "sonarpost.bus.router", "--listen", endpoint, "--connect", shore)
            processes.start(f"relay-{vessel}", "-m", "sonarpost.services.relay", "--config", str(file))
        yield processes, endpoints, shore
    finally:
        processes.stop()


def open_session(endpoint: str) -> zenoh.Session:
    """Return a client session; the router may still be starting."""
    deadline = time.monotonic() + 30
    while True:
        try:
            return zenoh.open(client_config([endpoint]))
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def wait_until_ready(session: zenoh.Session, vessels: Sequence[str]) -> None:
    """Wait until the shore site reaches c2 and every relay."""
    expected = {keys.alive("shore-1", "c2"), *(keys.alive(vessel, "relay") for vessel in vessels)}
    deadline = time.monotonic() + 60
    alive: set[str] = set()
    while not expected <= alive:
        if time.monotonic() > deadline:
            sys.exit(f"fleet: not started: {sorted(expected - alive)}")
        time.sleep(0.2)
        replies = session.liveliness().get(keys.alive_everywhere(), timeout=2.0)
        alive = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def run(folder: Path, vehicles: int, vessels: int, seconds: float, every_s: float) -> dict[str, object]:
    """Run once; return the figures."""
    names = [f"vessel-{n + 1}" for n in range(vessels)]
    received = ReceivedImages()
    with fleet(folder, names) as (processes, endpoints, shore):
        session = open_session(shore)
        session.declare_subscriber(keys.shore_contact_all(), received.receive)
        wait_until_ready(session, names)
        services = tuple(processes.running)
        before = {name: processes.cpu_s(name) for name in services}
        host = HostLoad()
        started_s = time.monotonic()
        for n, name in enumerate(names):
            own_vehicles = ",".join(str(v) for v in range(n, vehicles, vessels))
            options = (endpoints[name], str(folder / "load"), name, own_vehicles, str(seconds), str(every_s))
            processes.start(f"load-{name}", "-m", "research.fleet", "--load", *options)
        queued = 0
        for name in names:
            output, _ = processes.running[f"load-{name}"].communicate(timeout=seconds + DRAIN_TIMEOUT_S + 60)
            queued += int(output)
        deadline = time.monotonic() + DRAIN_TIMEOUT_S
        # The subscriber may miss images under load; the index of c2 is authoritative.
        while images_at_shore(folder / "out") < queued and time.monotonic() < deadline:
            time.sleep(0.1)
        duration_s = time.monotonic() - started_s
        used = {name: processes.cpu_s(name) - before[name] for name in services}
        host_load = host.stop(sum(used.values()))
        memory = {name: processes.rss_mb(name) for name in services}
        session.close()
    return {
        **figures(vehicles, vessels, queued, duration_s, received, images_at_shore(folder / "out"), used, memory),
        **host_load,
    }


def images_at_shore(out_dir: Path) -> int:
    """Return the number of images in the index of c2."""
    index = ShoreIndex(out_dir, writable=False)
    try:
        return len(index.images())
    finally:
        index.close()


def figures(
    vehicles: int,
    vessels: int,
    queued: int,
    duration_s: float,
    received: ReceivedImages,
    rows: int,
    used: dict[str, float],
    memory: dict[str, float],
) -> dict[str, object]:
    """Return the figures of a run; for processes of one kind the largest value."""
    latency_ms = 1000 * np.array(sorted(received.latency_s.values()) or [float("nan")])
    kinds = {
        "c2": ("c2",),
        "relay": ("relay-",),
        "router_vessel": ("router-vessel",),
        "router_shore": ("router-shore",),
    }
    by_kind = {kind: [n for n in used if n.startswith(prefixes)] for kind, prefixes in kinds.items()}
    return {
        "vehicles": vehicles,
        "vessels": vessels,
        "images": queued,
        "ashore": rows,
        "shown": len(received.latency_s),
        "shown_again": received.again,
        "sha256_wrong": received.wrong,
        "seconds": round(duration_s, 1),
        "images_per_s": round(queued / duration_s, 2),
        "latency_p50_ms": round(float(np.percentile(latency_ms, 50)), 1),
        "latency_p99_ms": round(float(np.percentile(latency_ms, 99)), 1),
        "latency_max_ms": round(float(latency_ms[-1]), 1),
        "cpu_percent": {k: round(100 * max(used[n] for n in ns) / duration_s, 1) for k, ns in by_kind.items()},
        "cpu_ms_per_image": {k: round(1000 * sum(used[n] for n in ns) / queued, 2) for k, ns in by_kind.items()},
        "rss_mb": {k: round(max(memory[n] for n in ns)) for k, ns in by_kind.items()},
        "good": rows == queued and not received.wrong and not received.again,
    }


def main() -> int:
    """Run; return 1 if an image is missing or wrong."""
    parser = argparse.ArgumentParser(description="many vehicles over several vessels into one shore site")
    parser.add_argument("--vehicles", type=int, default=100, metavar="N", help="default: 100")
    parser.add_argument("--vessels", type=int, default=4, metavar="N", help="default: 4")
    parser.add_argument("--seconds", type=float, default=600.0, metavar="S", help="duration of each run; default: 600")
    parser.add_argument("--every", type=float, default=10.0, metavar="S", help="interval of a vehicle; default: 10 s")
    parser.add_argument("--grow", metavar="N,N", help="several runs with these numbers of vehicles")
    parser.add_argument("--dir", type=Path, metavar="DIR", help="folder for stores and files (default: temporary)")
    parser.add_argument("--load", nargs=6, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.load:
        endpoint, folder, vessel, vehicles, seconds, every = args.load
        own_vehicles = [int(v) for v in vehicles.split(",")]
        run_load(endpoint, Path(folder), vessel, own_vehicles, float(seconds), float(every))
        return 0
    passed = True
    for count in [int(n) for n in args.grow.split(",")] if args.grow else [args.vehicles]:
        with ProgressDisplay(step=f"fleet of {count}"), tempfile.TemporaryDirectory(dir=args.dir) as name:
            result = run(Path(name), count, args.vessels, args.seconds, args.every)
        print(json.dumps(result), flush=True)
        passed = passed and bool(result["good"])
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
