"""`python -m research.relay_throughput`: throughput of the relay, compared with bare Zenoh queries and with the disk.

    python -m research.relay_throughput [--decisions 20000] [--pictures 2000] [--dir DIR] [--profile]

There are two processes: the far side with the router, and this one. For three kinds of records (a decision, a coded
image of 200 bytes, and an image of 300 x 100 px as relays of earlier versions send it) these are measured:

- sequential: acknowledged queries without storage, one at a time, through the router to a queryable that replies at
  once;
- pipelined: the same with as many queries in flight as the delivery protocol has, a record (or a chunk of 32 kB) each;
- relay: a RelayService with the records in its inbox on disk. It moves each record to its outbox, delivers it to a c2
  that commits it, and deletes it, until both tables are empty. It logs one line a record to a file, as on a vessel;
  "unlogged" is the same with warnings only. The far side is a durable c2 that only stores records ("sink"), so that
  the delivery is measured and not the writing of TIFF files. This process has no other load;
- disk: the number of 4 kB writes a second that reach the disk, and the bytes a second with writes of 2 MB. The bound
  follows from both: every record is committed three times (outbox, inbox of c2, deletion), up to 512 records with one
  write, and its bytes are written four times (log and table on both sides).

With `--profile`, only the relay's work for coded images is measured, in CPU time of its threads by area. The profiler
makes calls of Python functions slower: the areas are to be compared with each other only.

One JSON object a line. The exit status is 0 if the relay, with logging, reaches half of the pipelined rate or of the
bound of the disk.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from unittest.mock import patch

import zenoh

from research.fleet import coded_image, noise_image
from sonarpost import keys, wire
from sonarpost.bus.session import client_config, router_config
from sonarpost.cli.demo.settings import free_ports
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery.congestion import MAX_WINDOW_BYTES
from sonarpost.delivery.protocol import CHUNK_BYTES
from sonarpost.delivery.scheduler import WINDOW
from sonarpost.logs import configure_logging
from sonarpost.messages import Decision, ImagePart, ReconstructedImage, Record, Relayed
from sonarpost.runtime.process import relax_garbage_collection
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

GOAL = 0.5
COMMITS, WRITES = 3, 4
SEQUENTIAL = 2000
BULK_BYTES = 2_000_000
VESSEL = "vessel-1"
BARE_KEY = "bench/bare"
AREAS = {
    "decode": ("sonarpost/wire.py", "decode"),
    "build_part": ("archive/image_parts.py", "whole_part"),
    "build_part_contact": ("link/received_image.py", "contact_record"),
    "encode": ("sonarpost/wire.py", "encode"),
    "log_line": ("logging/__init__.py", "info"),
    "commit_queued": ("runtime/service.py", "commit_batch"),
    "outbox_thread": ("delivery/outbox.py", "_run"),
    "outbox_thread_versions": ("relay/service.py", "on_acknowledged"),
}
"""Areas of the relay's work: the function, with all that it calls. The contact is a part of `build_part`, the stored
versions are a part of `outbox_thread`."""


class Sink(Service[ServiceConfig]):
    """A c2 that only commits records."""

    NAME = "c2"
    BATCH = 512

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return the records of the relays."""
        return {keys.shore_inbox_all(): Relayed, keys.shore_part_all(): ImagePart}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Do nothing: the record is on disk already."""


def far_side(endpoint: str, folder: Path) -> None:
    """Run router, sink and bare queryable until standard input ends."""
    router = zenoh.open(router_config([endpoint]))
    sink = Sink(platform("shore-1", endpoint, folder), ServiceConfig())
    sink.start()
    relax_garbage_collection()
    session = zenoh.open(client_config([endpoint]))

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"stored")

    session.declare_queryable(BARE_KEY, answer)
    print("ready", flush=True)
    sys.stdin.read()
    sink.stop()
    session.close()
    router.close()


def platform(name: str, endpoint: str, folder: Path) -> PlatformConfig:
    """Return the configuration of a platform."""
    return PlatformConfig(id=name, router=(endpoint,), state_dir=folder / name, health_interval_s=60.0)


def decision(number: int) -> Decision:
    """Return a decision of about 200 bytes."""
    return Decision(
        decision_id=f"d-{number}",
        vessel_id=VESSEL,
        vehicle_id="uuv-1",
        image_id="0001",
        image_version=1,
        verdict="unsure",
        operator="op",
        decided_utc_s=1.0,
    )


def image(number: int) -> ReconstructedImage:
    """Return an image of 300 x 100 px, 30 kB."""
    return noise_image(VESSEL, "uuv-1", f"{number:04d}", number, float(number))


@contextmanager
def bare_session(endpoint: str) -> Iterator[zenoh.Session]:
    """Yield a client session that reaches the queryable."""
    session = zenoh.open(client_config([endpoint]))
    try:
        while not any(reply.ok is not None for reply in session.get(BARE_KEY, timeout=1.0)):
            time.sleep(0.01)
        yield session
    finally:
        session.close()


def query(session: zenoh.Session, chunk: bytes) -> zenoh.handlers.Handler[zenoh.Reply]:
    """Send one bare query."""
    return session.get(BARE_KEY, payload=chunk, timeout=5, congestion_control=zenoh.CongestionControl.BLOCK)


def measure_bare(endpoint: str, payloads: Sequence[bytes], window: int) -> float:
    """Return records a second of bare acknowledged queries, in chunks like the relay's, `window` in flight."""
    in_flight: deque[zenoh.handlers.Handler[zenoh.Reply]] = deque()
    with bare_session(endpoint) as session:
        started = time.perf_counter()
        for payload in payloads:
            for offset in range(0, len(payload), CHUNK_BYTES):
                if len(in_flight) >= window:
                    in_flight.popleft().recv()
                in_flight.append(query(session, payload[offset : offset + CHUNK_BYTES]))
        while in_flight:
            in_flight.popleft().recv()
        return len(payloads) / (time.perf_counter() - started)


def measure_relay(endpoint: str, folder: Path, key: str, payloads: Sequence[bytes], level: str) -> tuple[float, float]:
    """Return records a second from the relay's inbox to the store of c2, and CPU time of each.

    A record counts when it is acknowledged and deleted.

    The CPU time, in microseconds, is that of this process, which runs the relay.
    """
    relay = RelayService(platform(VESSEL, endpoint, folder), RelayConfig())
    with relay.store.transaction() as tx:
        for payload in payloads:
            tx.accept(key, payload)
    relax_garbage_collection()
    with logged_to(folder / "relay.log", level):
        started, used = time.perf_counter(), time.process_time()
        relay.start()
        try:
            while relay.acknowledged_count("c2") < len(payloads) or relay.store.outbox_depth():
                time.sleep(0.005)
            seconds, used_s = time.perf_counter() - started, time.process_time() - used
        finally:
            relay.stop()
    return len(payloads) / seconds, 1e6 * used_s / len(payloads)


@contextmanager
def logged_to(path: Path, level: str) -> Iterator[None]:
    """Log like a service, to a file in place of standard error."""
    with path.open("w", buffering=1) as file, redirect_stderr(file):
        configure_logging("relay", level)
        try:
            yield
        finally:
            logging.getLogger().handlers.clear()


def measure_disk(folder: Path, size: int, seconds: float = 1.0) -> float:
    """Return the number of sequential writes of `size` bytes a second that reach the disk."""
    path = folder / "fsync"
    count = 0
    data = os.urandom(size)
    with path.open("wb", buffering=0) as file:
        started = time.perf_counter()
        while time.perf_counter() - started < seconds:
            file.seek(0)
            file.write(data)
            os.fsync(file.fileno())
            count += 1
        elapsed_s = time.perf_counter() - started
    path.unlink()
    return count / elapsed_s


def main() -> int:
    """Run; return 1 if a rate is below the goal."""
    parser = argparse.ArgumentParser(description="relay throughput against bare acknowledged queries")
    parser.add_argument(
        "--decisions", type=int, default=20000, metavar="N", help="also the number of coded images; default: 20000"
    )
    parser.add_argument("--pictures", type=int, default=2000, metavar="N", help="default: 2000")
    parser.add_argument("--dir", type=Path, metavar="DIR", help="folder for the stores (default: a temporary folder)")
    parser.add_argument("--profile", action="store_true", help="only the CPU time of the relay for coded images")
    parser.add_argument("--far-side", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.far_side:
        far_side(args.far_side[0], Path(args.far_side[1]))
        return 0
    with ProgressDisplay(step="relay_throughput"), tempfile.TemporaryDirectory(dir=args.dir) as name:
        return compare(Path(name), args.decisions, args.pictures, is_profile=args.profile)


def measure(endpoint: str, folder: Path, key: str, payloads: Sequence[bytes]) -> dict[str, float]:
    """Measure one kind of record; the bare rate before and after the relay, because the load of the host varies."""
    size = len(payloads[0])
    window = max(1, min(WINDOW, MAX_WINDOW_BYTES // size))
    sequential = measure_bare(endpoint, payloads[:SEQUENTIAL], 1)
    before = measure_bare(endpoint, payloads, window)
    relayed, cpu_us = measure_relay(endpoint, folder, key, payloads, "info")
    unlogged, unlogged_cpu_us = measure_relay(endpoint, folder, key, payloads, "warning")
    pipelined = (before + measure_bare(endpoint, payloads, window)) / 2
    fsyncs, bulk = measure_disk(folder, 4096), measure_disk(folder, BULK_BYTES) * BULK_BYTES
    bound = 1 / (COMMITS / (RelayService.BATCH * fsyncs) + WRITES * size / bulk)
    return {
        "records": len(payloads),
        "bytes": size,
        "sequential_per_s": round(sequential),
        "pipelined_per_s": round(pipelined),
        "relay_per_s": round(relayed),
        "unlogged_per_s": round(unlogged),
        "of_sequential": round(relayed / sequential, 2),
        "of_pipelined": round(relayed / pipelined, 3),
        "unlogged_of_pipelined": round(unlogged / pipelined, 3),
        "relay_cpu_us": round(cpu_us),
        "unlogged_cpu_us": round(unlogged_cpu_us),
        "relay_mb_per_s": round(relayed * size / 1e6, 2),
        "fsync_per_s": round(fsyncs),
        "disk_mb_per_s": round(bulk / 1e6),
        "disk_bound_per_s": round(bound),
        "of_disk_bound": round(relayed / bound, 3),
        "host_load": round(os.getloadavg()[0], 1),
    }


@contextmanager
def profiled_threads() -> Iterator[list[cProfile.Profile]]:
    """Profile the CPU time of all threads that start in the block."""
    profiles: list[cProfile.Profile] = []
    run = threading.Thread.run

    def profiled(thread: threading.Thread) -> None:
        profile = cProfile.Profile(time.thread_time)
        profiles.append(profile)
        profile.runcall(run, thread)

    with patch.object(threading.Thread, "run", profiled):
        yield profiles


def profile_relay(endpoint: str, folder: Path, count: int) -> dict[str, object]:
    """Return the CPU time of each area of the relay for a coded image, in microseconds with the profiler."""
    payloads = [wire.encode(coded_image(VESSEL, 1, n, time.time())) for n in range(count)]
    with profiled_threads() as profiles:
        measure_relay(endpoint, folder, keys.image_coded(VESSEL), payloads, "info")
    totals = dict.fromkeys((*AREAS, "all"), 0.0)
    for profile in profiles:
        profile.create_stats()
        for (file, _, function), (_, _, own_s, with_callees_s, _) in profile.stats.items():
            totals["all"] += own_s
            for area, (path, name) in AREAS.items():
                if function == name and file.endswith(path):
                    totals[area] += with_callees_s
    return {area: round(1e6 * seconds / count, 1) for area, seconds in totals.items()}


def compare(folder: Path, decisions: int, images: int, *, is_profile: bool) -> int:
    """Measure both kinds of records; return 1 if a rate is below the goal."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    child = subprocess.Popen(
        [sys.executable, "-m", "research.relay_throughput", "--far-side", endpoint, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdin is not None
    passed = True
    try:
        if child.stdout.readline().strip() != "ready":
            sys.exit("relay_throughput: the far side did not start")
        if is_profile:
            print(json.dumps({"record": "stream", "cpu_us": profile_relay(endpoint, folder, decisions)}), flush=True)
            return 0
        kinds: list[tuple[str, str, list[bytes]]] = [
            ("decision", keys.contact_decision(VESSEL), [wire.encode(decision(n)) for n in range(decisions)]),
            (
                "stream",
                keys.image_coded(VESSEL),
                [wire.encode(coded_image(VESSEL, 1, n, time.time())) for n in range(decisions)],
            ),
            ("picture", keys.image_reconstructed(VESSEL), [wire.encode(image(n)) for n in range(images)]),
        ]
        for name, key, payloads in kinds:
            result = measure(endpoint, folder, key, payloads)
            print(json.dumps({"record": name, **result}), flush=True)
            passed = passed and result["relay_per_s"] >= GOAL * min(
                result["pipelined_per_s"], result["disk_bound_per_s"]
            )
    finally:
        child.stdin.close()
        child.wait(timeout=10)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
