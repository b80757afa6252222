"""A fleet on one host: many vehicles over a few vessels into one shore, for minutes.

    python -m research.fleet [--vehicles 100] [--vessels 4] [--seconds 600] [--every 10] [--grow 10,30] [--dir DIR]

Real, each a process of its own with its own store: a router and a relay for each vessel, the shore's router, and c2,
which writes every picture's files. Simulated: the vehicles, the water and the decompressor. One load process a vessel
stands in for these: it owes a reconstructed picture of 100 x 300 px to the relay through a durable outbox of its own,
for each of its vehicles once every `--every` seconds at a random phase. (By sound, a picture of the paper takes two
packets and more than that.) All run on this host, so there is one clock: a picture's latency is from the moment it is
owed, before it is on the disk of the load process, until a plain subscriber ashore has it from c2, after c2 has written
its files.

One JSON object a run, with the host's load average during it (mean of samples of the one-minute average) and how much
of the host's CPU was in use by all that ran on it, and by the bench's own processes. The exit status is 0 where every
picture is ashore once, with the right sha256.


## research.fleet
Pictures for the benches: noise, so that nothing on the way can make them smaller, and none twice.
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
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Pixels, ReconstructedImage, Record
from sonarpost.parent_process import EXIT_WITH_PARENT
from sonarpost.runtime.service import Service, UnitOfWork

SETTLE_S = 120.0
SAMPLE_S = 5.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class Load(Service[ServiceConfig]):
    """Vehicles, water and decompressor of one vessel: an outbox that owes pictures."""

    NAME = "load"
    PUBLISH = False

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """It takes nothing."""
        raise NotImplementedError


def picture(vessel: str, vehicle: int, number: int, now_utc_s: float) -> ReconstructedImage:
    """Return a picture of noise, 30 kB, that no other number has."""
    return noise_picture(vessel, f"uuv-{vehicle}", f"{number:04X}", [vehicle, number], now_utc_s)


def run_load(endpoint: str, folder: Path, vessel: str, vehicles: Sequence[int], seconds: float, every_s: float) -> None:
    """Owe pictures for a time, then wait until the relay has them; print how many there were."""
    platform = PlatformConfig(id=vessel, router=(endpoint,), state_dir=folder / vessel, health_interval_s=60.0)
    load = Load(platform, ServiceConfig())
    load.start()
    rng = random.Random(vehicles[0])
    began_s = time.monotonic()
    due = sorted((rng.uniform(0, every_s) + n * every_s, v, n) for v in vehicles for n in range(int(seconds / every_s)))
    for at_s, vehicle, number in due:
        load.stopping.wait(max(0.0, began_s + at_s - time.monotonic()))
        effects = UnitOfWork()
        effects.send(
            keys.image_reconstructed(vessel), "relay", picture(vessel, vehicle, number, time.time()), priority=5
        )
        load.commit(effects)
    ends_s = time.monotonic() + SETTLE_S
    while load.store.outbox_depth() and time.monotonic() < ends_s:
        load.stopping.wait(0.1)
    print(len(due), flush=True)
    load.stop()


@dataclass
class Seen:
    """What a plain subscriber ashore has seen.

    Attributes:
        latency_s: By picture, of the first time it was shown.
    """

    latency_s: dict[tuple[str, str, float], float] = field(default_factory=dict)
    wrong: int = 0
    again: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)

    def take(self, sample: zenoh.Sample) -> None:
        """Note a picture."""
        now_utc_s = time.time()
        image = msgpack.unpackb(sample.payload.to_bytes())  # no more than that: this process has the services' cores
        name = (image["vehicle_id"], image["image_id"], image["first_frame_utc_s"])
        with self.lock:
            if hashlib.sha256(image["picture"]["data"]).hexdigest() != image["picture_sha256"]:
                self.wrong += 1
            if name in self.latency_s:
                self.again += 1
            else:
                self.latency_s[name] = now_utc_s - image["last_frame_utc_s"]


class HostLoad:
    """How busy the whole host is: samples of its load average, and its CPU time."""

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
        """Return load average (mean, highest) and CPU in use (percent of all cores) since the beginning.

        Args:
            services_s: CPU time the services have used; this process and those of the load are added.
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
    """The processes of one run, and what they have used."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.running: dict[str, subprocess.Popen[str]] = {}

    def start(self, name: str, *command: str) -> None:
        """Start a process of this interpreter; what it logs goes to a file."""
        environment = {**os.environ, EXIT_WITH_PARENT: str(os.getpid()), "OMP_NUM_THREADS": "1"}
        with (self._folder / f"{name}.log").open("ab") as log:
            self.running[name] = subprocess.Popen(
                [sys.executable, *command], stdout=subprocess.PIPE, stderr=log, text=True, env=environment
            )

    def cpu_s(self, name: str) -> float:
        """Return the CPU time a process has used, user's and system's."""
        stat = Path(f"/proc/{self.running[name].pid}/stat").read_text()
        fields = stat.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS_PER_S

    def rss_mb(self, name: str) -> float:
        """Return the memory a process has in use, MB."""
        status = Path(f"/proc/{self.running[name].pid}/status").read_text()
        [line] = [text for text in status.splitlines() if text.startswith("VmRSS")]
        return int(line.split()[1]) / 1024

    def stop(self) -> None:
        """Stop all."""
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
    """Routers, relays and c2; gives the processes, each vessel's endpoint and the shore's."""
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
    """Return a client's session with a router that may still be starting."""
    deadline = time.monotonic() + 30
    while True:
        try:
            return zenoh.open(client_config([endpoint]))
        except zenoh.ZError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)


def wait_until_ready(session: zenoh.Session, vessels: Sequence[str]) -> None:
    """Wait until c2 and every relay are there, seen from the shore."""
    wanted = {keys.alive("shore-1", "c2"), *(keys.alive(vessel, "relay") for vessel in vessels)}
    deadline = time.monotonic() + 60
    alive: set[str] = set()
    while not wanted <= alive:
        if time.monotonic() > deadline:
            sys.exit(f"fleet: not started: {sorted(wanted - alive)}")
        time.sleep(0.2)
        replies = session.liveliness().get(keys.alive_everywhere(), timeout=2.0)
        alive = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def run(folder: Path, vehicles: int, vessels: int, seconds: float, every_s: float) -> dict[str, object]:
    """Run once; return the figures."""
    names = [f"vessel-{n + 1}" for n in range(vessels)]
    seen = Seen()
    with fleet(folder, names) as (processes, endpoints, shore):
        session = open_session(shore)
        session.declare_subscriber(keys.shore_contact_all(), seen.take)
        wait_until_ready(session, names)
        services = tuple(processes.running)
        before = {name: processes.cpu_s(name) for name in services}
        host = HostLoad()
        began_s = time.monotonic()
        for n, name in enumerate(names):
            mine = ",".join(str(v) for v in range(n, vehicles, vessels))
            options = (endpoints[name], str(folder / "load"), name, mine, str(seconds), str(every_s))
            processes.start(f"load-{name}", "-m", "research.fleet", "--load", *options)
        owed = 0
        for name in names:
            output, _ = processes.running[f"load-{name}"].communicate(timeout=seconds + SETTLE_S + 60)
            owed += int(output)
        deadline = time.monotonic() + SETTLE_S
        # A plain subscriber may miss some under load; the files are what counts.
        while rows_ashore(folder / "out") < owed and time.monotonic() < deadline:
            time.sleep(0.1)
        took_s = time.monotonic() - began_s
        used = {name: processes.cpu_s(name) - before[name] for name in services}
        host_load = host.stop(sum(used.values()))
        memory = {name: processes.rss_mb(name) for name in services}
        session.close()
    return {**figures(vehicles, vessels, owed, took_s, seen, rows_ashore(folder / "out"), used, memory), **host_load}


def rows_ashore(out_dir: Path) -> int:
    """Return how many pictures c2 has in its index, each once."""
    index = ShoreIndex(out_dir, writable=False)
    try:
        return len(index.images())
    finally:
        index.close()


def figures(
    vehicles: int,
    vessels: int,
    owed: int,
    took_s: float,
    seen: Seen,
    rows: int,
    used: dict[str, float],
    memory: dict[str, float],
) -> dict[str, object]:
    """Return what a run has shown; processes of one kind are given by their largest."""
    latency_ms = 1000 * np.array(sorted(seen.latency_s.values()) or [float("nan")])
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
        "images": owed,
        "ashore": rows,
        "shown": len(seen.latency_s),
        "shown_again": seen.again,
        "sha256_wrong": seen.wrong,
        "seconds": round(took_s, 1),
        "images_per_s": round(owed / took_s, 2),
        "latency_p50_ms": round(float(np.percentile(latency_ms, 50)), 1),
        "latency_p99_ms": round(float(np.percentile(latency_ms, 99)), 1),
        "latency_max_ms": round(float(latency_ms[-1]), 1),
        "cpu_percent": {k: round(100 * max(used[n] for n in ns) / took_s, 1) for k, ns in by_kind.items()},
        "cpu_ms_per_image": {k: round(1000 * sum(used[n] for n in ns) / owed, 2) for k, ns in by_kind.items()},
        "rss_mb": {k: round(max(memory[n] for n in ns)) for k, ns in by_kind.items()},
        "good": rows == owed and not seen.wrong and not seen.again,
    }


def main() -> int:
    """Run; return 1 if a picture is missing or wrong."""
    parser = argparse.ArgumentParser(description="many vehicles over a few vessels into one shore")
    parser.add_argument("--vehicles", type=int, default=100, metavar="N", help="default: 100")
    parser.add_argument("--vessels", type=int, default=4, metavar="N", help="default: 4")
    parser.add_argument("--seconds", type=float, default=600.0, metavar="S", help="of each run; default: 600")
    parser.add_argument("--every", type=float, default=10.0, metavar="S", help="a picture a vehicle; default: 10 s")
    parser.add_argument("--grow", metavar="N,N", help="several runs, with these numbers of vehicles")
    parser.add_argument("--dir", type=Path, metavar="DIR", help="where stores and files are (default: temporary)")
    parser.add_argument("--load", nargs=6, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.load:
        endpoint, folder, vessel, vehicles, seconds, every = args.load
        mine = [int(v) for v in vehicles.split(",")]
        run_load(endpoint, Path(folder), vessel, mine, float(seconds), float(every))
        return 0
    good = True
    for count in [int(n) for n in args.grow.split(",")] if args.grow else [args.vehicles]:
        with tempfile.TemporaryDirectory(dir=args.dir) as name:
            result = run(Path(name), count, args.vessels, args.seconds, args.every)
        print(json.dumps(result), flush=True)
        good = good and bool(result["good"])
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())


SHAPE = (100, 300)
"""Height and width in pixels: 30 kB."""


def noise_picture(
    vessel_id: str, vehicle_id: str, image_id: str, seed: int | Sequence[int], first_frame_utc_s: float
) -> ReconstructedImage:
    """Return a picture that has arrived whole; the same seed gives the same pixels."""
    raster = Pixels.from_array(np.random.default_rng(seed).integers(0, 256, SHAPE, dtype=np.uint8))
    return ReconstructedImage(
        vessel_id=vessel_id,
        vehicle_id=vehicle_id,
        image_id=image_id,
        version=1,
        contact=None,
        codec="vq",
        model="",
        picture=raster,
        picture_sha256=raster.sha256,
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
