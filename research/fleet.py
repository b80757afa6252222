"""`python -m research.fleet`: many vehicles over several vessels into one shore site, on one host.

    python -m research.fleet [--vehicles 100] [--vessels 4] [--seconds 600] [--every 10] [--grow 10,30]
    python -m research.fleet --accept 20000 [--dir DIR]

Real processes, each with its own store: a router and a relay for each vessel, the router of the shore site, and c2,
which writes the files of every image. Vehicles, acoustic channel and decompressor are replaced by one load process a
vessel: it queues a coded image of 300 x 100 px and 200 bytes for the relay in its durable outbox, for each of its
vehicles once every `--every` seconds at a random phase. Other work on the host changes all figures.

All processes run on this host and share one clock. Both latencies of an image start when it is queued, before it is
written to disk:

- `acknowledged_*_ms`: until the relay removes it, because c2 has acknowledged it after its commit to the disk. The
  relay is `research.recording_relay`, which records this time;
- `shown_*_ms`: until a subscriber at the shore site receives the decoded image from c2, after c2 has written its files.

With `--accept N`, c2 accepts N contacts of 200 coded bytes from the relays of two vessels, half from each, as fast as
all processes can. A contact counts when c2 has committed it to its disk; the time starts with the first one. The
decoders of c2 work behind the acceptance, with lower priority, on the same cores; the object states how many images
they have stored when the last contact is accepted. There are two runs:

- The relays start with the records in their inboxes: their start and the preparation of the records for c2 are a part
  of the time (`senders_prepared` false);
- N coded images that the relays have prepared and queued for c2 before c2 starts (`senders_prepared` true): the rate of
  c2 and of the delivery to it, with less of the work of the vessels, which have their own processors.

Each run prints one JSON object, including the load average of the host (mean of samples of the one-minute average) and
the CPU usage of all processes of the host and of this benchmark. The exit status is 0 if every image was acknowledged
and arrived once at the shore site with the correct sha256.
"""

import argparse
import hashlib
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh
from typing_extensions import override

from research.common.ports import free_ports
from research.recording_relay import acknowledged
from sonarpost import keys, wire
from sonarpost.archive.reader import open_reader
from sonarpost.bus.session import client_config
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.registry import default_registry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery.store import Store
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.contact_record import ContactSummary, contact_of
from sonarpost.messages import CodedImage, ReconstructedImage, Record
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.stop_signals import EXIT_WITH_PARENT

DRAIN_TIMEOUT_S = 120.0
SAMPLE_S = 5.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
STREAM_BYTES, STREAMS = 200, 8
ACCEPT_TIMEOUT_S = 300.0
SHAPE = (100, 300)
"""Height and width in pixels: 30 kB."""


class Load(Service[ServiceConfig]):
    """Load of one vessel: an outbox with coded images."""

    NAME = "load"
    PUBLISH = False

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """No records are consumed."""
        raise NotImplementedError


@cache
def coded_streams() -> tuple[bytes, ...]:
    """Return streams of `emb` of 200 bytes each, of images of 300 x 100 px."""
    rng = np.random.default_rng(1)
    codec = default_registry().create("emb")
    images = [np.clip(rng.rayleigh(40.0, SHAPE), 0, 255).astype(np.uint8) for _ in range(STREAMS)]
    return tuple(codec.encode(image, STREAM_BYTES) for image in images)


def coded_image(vessel: str, vehicle: int, number: int, now_utc_s: float, stream: bytes | None = None) -> CodedImage:
    """Return a contact with its coded image, as a vessel has received it; without `stream`, the streams repeat."""
    rng = np.random.default_rng([vehicle, number])
    if stream is None:
        stream = coded_streams()[number % STREAMS]
    name, image_id = f"uuv-{vehicle}", image_of_number(number % 65535 + 1)
    contact = ContactSummary(
        height_px=SHAPE[0],
        width_px=SHAPE[1],
        lat_deg=rng.uniform(56.0, 57.0),
        lon_deg=rng.uniform(-6.0, -5.0),
        time_utc_s=now_utc_s,
        confidence=1.5,
        heading_deg=90.0,
        altitude_m=5.0,
        depth_m=20.0,
        atd_class="mine_like",
        p_mine_like=0.75,
        p_other_object=0.2,
    ).rounded()
    return CodedImage(
        vessel_id=vessel,
        vehicle_id=name,
        image_id=image_id,
        version=1,
        contact=contact_of(contact, name, image_id),
        height_px=SHAPE[0],
        width_px=SHAPE[1],
        stream=stream,
        missing=(),
        missing_halves=(),
        complete=True,
        bytes_received=len(stream),
        bytes_total=len(stream),
        frames_received=4,
        conflicts=0,
        first_frame_utc_s=now_utc_s,
        last_frame_utc_s=now_utc_s,
        authenticated=True,
        codec="emb",
        model="",
    )


def run_load(
    endpoint: str,
    folder: Path,
    vessel: str,
    vehicles: Sequence[int],
    seconds: float,
    every_s: float,
) -> None:
    """Queue images for a time, then wait until the relay has accepted them; print their number."""
    key = keys.image_coded(vessel)
    coded_image(vessel, vehicles[0], 0, 0.0)  # prepares the streams before the time starts
    platform = PlatformConfig(id=vessel, router=(endpoint,), state_dir=folder / vessel, health_interval_s=60.0)
    load = Load(platform, ServiceConfig())
    load.start()
    rng = random.Random(vehicles[0])
    started_s = time.monotonic()
    due = sorted((rng.uniform(0, every_s) + n * every_s, v, n) for v in vehicles for n in range(int(seconds / every_s)))
    for at_s, vehicle, number in due:
        load.stopping.wait(max(0.0, started_s + at_s - time.monotonic()))
        effects = UnitOfWork()
        effects.send(key, "relay", coded_image(vessel, vehicle, number, time.time()), priority=5)
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
        if image["type"] != ReconstructedImage.TYPE:
            return  # the coded form, which c2 publishes before it decodes it
        name = (image["vehicle_id"], image["image_id"], image["first_frame_utc_s"])
        with self.lock:
            if hashlib.sha256(image["pixels"]["data"]).hexdigest() != image["pixels_sha256"]:
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


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


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
        return _cpu_s(self.running[name].pid)

    def children_cpu_s(self, name: str) -> float:
        """Return user and system CPU time of the running child processes of a process."""
        children = [path.read_text() for path in Path(f"/proc/{self.running[name].pid}/task").glob("*/children")]
        return sum(_cpu_s(int(pid)) for text in children for pid in text.split())

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
def fleet(
    folder: Path, vessels: Sequence[str], *, start_relays: bool = True, start_c2: bool = True
) -> Iterator[tuple[Processes, dict[str, str], str]]:
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
        if start_c2:
            run_c2(processes, folder)
        for vessel, endpoint in endpoints.items():
            file = folder / f"{vessel}.toml"
            file.write_text(
                f'[platform]\nid = "{vessel}"\nrouter = ["{endpoint}"]\nstate_dir = "{folder / vessel}"\n[relay]\n'
            )
            processes.start(f"router-{vessel}", "-m", "sonarpost.bus.router", "--listen", endpoint, "--connect", shore)
            if start_relays:
                processes.start(f"relay-{vessel}", "-m", "research.recording_relay", "--config", str(file))
        yield processes, endpoints, shore
    finally:
        processes.stop()


def run_c2(processes: Processes, folder: Path) -> None:
    """Start c2 with the configuration that `fleet` has written."""
    processes.start("c2", "-m", "sonarpost.services.c2", "--config", str(folder / "shore.toml"))


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


def wait_until_alive(session: zenoh.Session, expected: Set[str], timeout_s: float) -> None:
    """Wait until a session receives the liveliness tokens of these keys; exit after the time-out."""
    deadline_s = time.monotonic() + timeout_s
    alive: set[str] = set()
    while not expected <= alive:
        if time.monotonic() > deadline_s:
            sys.exit(f"not started: {sorted(expected - alive)}")
        time.sleep(0.2)
        replies = session.liveliness().get(keys.alive_everywhere(), timeout=2.0)
        alive = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def wait_until_ready(session: zenoh.Session, vessels: Sequence[str]) -> None:
    """Wait until the shore site reaches c2 and every relay."""
    expected = {keys.alive("shore-1", "c2"), *(keys.alive(vessel, "relay") for vessel in vessels)}
    wait_until_alive(session, expected, 60.0)


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
        used["decoders"] = processes.children_cpu_s("c2")
        host_load = host.stop(sum(used.values()))
        memory = {name: processes.rss_mb(name) for name in services}
        session.close()
    entries = [entry for name in names for entry in acknowledged(folder / name)]
    return {
        "vehicles": vehicles,
        "vessels": vessels,
        "bytes_mean": round(sum(entry["bytes"] for entry in entries) / len(entries)),
        **figures(queued, duration_s, received, images_at_shore(folder / "out"), entries, used, memory),
        **host_load,
    }


def accept(folder: Path, count: int, *, is_prepared: bool) -> dict[str, object]:
    """Hand over contacts of two vessels as fast as relays and c2 can; return the figures.

    Args:
        folder: Folder for stores and files.
        count: Number of contacts.
        is_prepared: The relays queue all contacts for c2 before c2 starts.
    """
    names = ["vessel-1", "vessel-2"]
    now_utc_s = time.time()
    for vehicle, name in enumerate(names, start=1):
        (folder / name).mkdir(parents=True)
        store = Store(folder / name / "relay.db")
        with store.transaction() as tx:
            for number in range(count // 2):
                record = coded_image(name, vehicle, number, now_utc_s + number * 1e-3)
                tx.accept(keys.image_coded(name), wire.encode(record))
        store.close()
    with fleet(folder, names, start_relays=False, start_c2=not is_prepared) as (processes, _, shore):
        session = open_session(shore)
        before = dict[str, float]()
        if not is_prepared:
            wait_until_ready(session, [])
            before = {name: processes.cpu_s(name) for name in ("c2", "router-shore")}
        for name in names:
            processes.start(f"relay-{name}", "-m", "sonarpost.services.relay", "--config", str(folder / f"{name}.toml"))
        if is_prepared:
            wait_until_queued([folder / name / "relay.db" for name in names])
            run_c2(processes, folder)
        c2_db = folder / "shore" / "c2.db"
        samples: list[tuple[float, int]] = []
        deadline_s = time.monotonic() + ACCEPT_TIMEOUT_S
        while (not samples or samples[-1][1] < count) and time.monotonic() < deadline_s:
            accepted = accepted_records(c2_db)
            if accepted:
                if is_prepared and not samples:
                    before = {name: processes.cpu_s(name) for name in processes.running}
                samples.append((time.monotonic(), accepted))
            time.sleep(0.02)
        used = {name: processes.cpu_s(name) - before.get(name, 0.0) for name in processes.running}
        stored = images_at_shore(folder / "out")
        session.close()
    seconds = samples[-1][0] - samples[0][0]
    accepted = samples[-1][1] - samples[0][1]
    return {
        "senders_prepared": is_prepared,
        "contacts": samples[-1][1],
        "accepted_per_s": round(accepted / seconds),
        "stored_when_all_accepted": stored,
        "c2_cpu_ms_per_contact": round(1000 * used["c2"] / count, 3),
        "relay_cpu_ms_per_contact": round(1000 * sum(used[f"relay-{n}"] for n in names) / count, 3),
        "router_cpu_ms_per_contact": round(1000 * used["router-shore"] / count, 3),
        "load_average": round(os.getloadavg()[0], 1),
        "cores": os.cpu_count(),
        "good": samples[-1][1] == count,
    }


def accepted_records(store: Path) -> int:
    """Return the number of records that were ever committed to an inbox, from SQLite's autoincrement counter."""
    try:
        return read_int(store, "SELECT COALESCE(MAX(seq), 0) FROM sqlite_sequence WHERE name = 'inbox'")
    except sqlite3.OperationalError:
        return 0  # the service is creating it


def wait_until_queued(stores: Sequence[Path]) -> None:
    """Wait until relays have queued all records of their inboxes for the shore site."""
    deadline_s = time.monotonic() + ACCEPT_TIMEOUT_S
    while any(read_int(store, "SELECT EXISTS (SELECT 1 FROM inbox)") for store in stores):
        if time.monotonic() > deadline_s:
            sys.exit("fleet: the relays have not queued their records")
        time.sleep(0.2)


def read_int(store: Path, sql: str) -> int:
    """Return the single number of a query of a store that another process uses."""
    with closing(sqlite3.connect(f"file:{store}?mode=ro", uri=True)) as db:
        return int(db.execute(sql).fetchone()[0])


def images_at_shore(out_dir: Path) -> int:
    """Return the number of images in the index of c2."""
    with open_reader(out_dir) as archive:
        return len(archive.images())


def figures(
    queued: int,
    duration_s: float,
    received: ReceivedImages,
    rows: int,
    entries: Sequence[Mapping[str, Any]],
    used: dict[str, float],
    memory: dict[str, float],
) -> dict[str, object]:
    """Return the figures of a run; of processes of one kind the sum of the CPU time and the largest memory."""
    by_kind = {
        kind: [name for name in used if name.startswith(prefix)]
        for kind, prefix in {
            "c2": "c2",
            "decoders": "decoders",
            "relays": "relay-",
            "routers_vessels": "router-vessel",
            "router_shore": "router-shore",
        }.items()
    }
    cpu_ms = {kind: round(1000 * sum(used[n] for n in ns) / queued, 2) for kind, ns in by_kind.items()}
    return {
        "contacts": queued,
        "acknowledged": sum(not entry["refused"] for entry in entries),
        "ashore": rows,
        "shown": len(received.latency_s),
        "shown_again": received.again,
        "sha256_wrong": received.wrong,
        "seconds": round(duration_s, 1),
        "contacts_per_s": round(queued / duration_s, 2),
        **percentiles("acknowledged", [entry["acknowledged_utc_s"] - entry["queued_utc_s"] for entry in entries]),
        **percentiles("shown", list(received.latency_s.values())),
        "cpu_ms_per_contact": {"all": round(sum(cpu_ms.values()), 2), **cpu_ms},
        "rss_mb": {k: round(max(memory[n] for n in ns)) for k, ns in by_kind.items() if k != "decoders"},
        "good": rows == queued == len(entries) and not received.wrong and not received.again,
    }


def percentiles(name: str, latency_s: Sequence[float]) -> dict[str, float]:
    """Return the percentiles 50 and 99 of latencies in milliseconds, as two fields that begin with `name`."""
    p50, p99 = np.percentile(1000 * np.array(latency_s or [float("nan")]), (50, 99))
    return {f"{name}_p50_ms": round(float(p50), 1), f"{name}_p99_ms": round(float(p99), 1)}


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
    parser.add_argument("--accept", type=int, metavar="N", help="measure the acceptance of N contacts instead")
    args = parser.parse_args()
    if args.load:
        endpoint, folder, vessel, vehicles, seconds, every = args.load
        own_vehicles = [int(v) for v in vehicles.split(",")]
        run_load(endpoint, Path(folder), vessel, own_vehicles, float(seconds), float(every))
        return 0
    passed = True
    for is_prepared in (False, True) if args.accept else ():
        with ProgressDisplay(step="acceptance"), tempfile.TemporaryDirectory(dir=args.dir) as name:
            result = accept(Path(name), args.accept, is_prepared=is_prepared)
        print(json.dumps(result), flush=True)
        passed = passed and bool(result["good"])
    if args.accept:
        return 0 if passed else 1
    for count in [int(n) for n in args.grow.split(",")] if args.grow else [args.vehicles]:
        with ProgressDisplay(step=f"fleet of {count}"), tempfile.TemporaryDirectory(dir=args.dir) as name:
            result = run(Path(name), count, args.vessels, args.seconds, args.every)
        print(json.dumps(result), flush=True)
        passed = passed and bool(result["good"])
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
