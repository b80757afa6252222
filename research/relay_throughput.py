"""`python -m research.relay_throughput`: throughput of the relay, compared with other software that stores on disk.

    python -m research.relay_throughput [--records 10000] [--rounds 5] [--peers NAME,…] [--dir DIR] [--profile]

For decisions and for coded images of 200 bytes, records wait on the disk of a sender, and the rate is measured at which
a receiver stores them: in records a second from the first arrival on, until the receiver has stored all. Each round
measures all systems one after the other, because the load of the host varies; the ratios are medians of the ratios of
a round. Of a coded image, the other systems transfer the bytes that the shore site receives. The systems:

- sonarpost: a RelayService in this process with the records in its inbox. It moves each record to its outbox, and
  delivers it through a router to a c2 in another process that only commits records ("sink"), so that the delivery is
  measured and not the writing of TIFF files. A record counts when the relay has the acknowledgement of c2;
- nats, rabbitmq, redis: two servers each of NATS, RabbitMQ and Redis, which this command starts (`research.peers`). A
  peer that is not installed is skipped, with the reason;
- zenoh: bare queries through the same router to a queryable that answers at once, with as many in flight as the
  delivery protocol has, a record (or a chunk of 32 kB) each. Nothing is stored: this is the bound.

"fsync_per_s" is the number of writes of 4 kB a second that reach the disk, "relay_cpu_us" the CPU time of a record in
the relay's process.

With `--profile`, only the relay's work for coded images is measured, in CPU time of its threads by area. The profiler
makes calls of Python functions slower: the areas are to be compared with each other only.

One JSON object a line. The exit status is 0 if the ratios reach 4 times NATS and once RabbitMQ for decisions, and twice
NATS for coded images; those of skipped peers do not count.
"""

import argparse
import cProfile
import json
import logging
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import zenoh
from typing_extensions import override

from research.common.ports import free_ports
from research.fleet import coded_image
from research.peers import PEERS, AbsentError, Peer
from research.peers.base import StartError
from sonarpost import keys, wire
from sonarpost.archive.image_parts import whole_part
from sonarpost.bus.session import client_config, router_config
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery.congestion import MAX_WINDOW_BYTES
from sonarpost.delivery.protocol import CHUNK_BYTES
from sonarpost.delivery.scheduler import WINDOW
from sonarpost.logs import configure_logging
from sonarpost.messages import Decision, ImagePart, Record, Relayed
from sonarpost.runtime.process import tune_interpreter
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

AIMS = {("decision", "nats"): 4.0, ("decision", "rabbitmq"): 1.0, ("coded image", "nats"): 2.0}
"""Least ratio of the relay's rate to that of a peer."""
FSYNC_S = 0.5
VESSEL = "vessel-1"
BARE_KEY = "bench/bare"
AREAS = {
    "decode": ("sonarpost/wire.py", "decode"),
    "build_part": ("archive/image_parts.py", "whole_part"),
    "build_part_contact": ("link/frames/contact_record.py", "exact_record"),
    "encode": ("sonarpost/wire.py", "encode"),
    "log_line": ("logging/__init__.py", "info"),
    "commit_queued": ("runtime/service.py", "commit_batch"),
    "outbox_thread": ("delivery/queue_sender.py", "_run"),
    "outbox_thread_versions": ("relay/service.py", "on_acknowledged"),
}
"""Areas of the relay's work: the function, with all that it calls. The contact is a part of `build_part`, the stored
versions are a part of `outbox_thread`."""


class Sink(Service[ServiceConfig]):
    """A c2 that only commits records."""

    NAME = "c2"
    BATCH = 512

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return the records of the relays."""
        return {keys.shore_inbox_all(): Relayed, keys.shore_part_all(): ImagePart}

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Do nothing: the record is on disk already."""


def far_side(endpoint: str, folder: Path) -> None:
    """Run router, sink and bare queryable until standard input ends."""
    router = zenoh.open(router_config([endpoint]))
    sink = Sink(platform("shore-1", endpoint, folder), ServiceConfig())
    sink.start()
    tune_interpreter()
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
    """Return a decision of about 200 bytes about an image of its own."""
    return Decision(
        decision_id=f"d-{number}",
        vessel_id=VESSEL,
        vehicle_id="uuv-1",
        image_id=f"{number:04X}",
        image_version=1,
        verdict="unsure",
        operator="op",
        decided_utc_s=1.0,
    )


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


def measure_bare(endpoint: str, payloads: Sequence[bytes]) -> float:
    """Return records a second of bare acknowledged queries, in chunks and as many in flight as the relay has."""
    window = max(1, min(WINDOW, MAX_WINDOW_BYTES // len(payloads[0])))
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


@dataclass(frozen=True)
class Records:
    """Records of one kind.

    Attributes:
        key: Key under which the relay accepts them.
        accepted: Encoded as the relay accepts them.
        sent: Encoded as the site receives them: what the other systems transfer.
    """

    key: str
    accepted: Sequence[bytes]
    sent: Sequence[bytes]


class Relay(Peer):
    """A relay that delivers to the sink."""

    def __init__(self, relay: RelayService, key: str) -> None:
        self._relay, self._key = relay, key

    @override
    def fill(self, payloads: Sequence[bytes]) -> None:
        """Store records in the inbox of the relay."""
        with self._relay.store.transaction() as tx:
            for payload in payloads:
                tx.accept(self._key, payload)

    @override
    def connect(self) -> None:
        """Start the relay."""
        self._relay.start()

    @override
    def stored(self) -> int:
        """Return the number of records that c2 has acknowledged."""
        return self._relay.acknowledged_count("c2")


def measure_relay(endpoint: str, folder: Path, key: str, payloads: Sequence[bytes]) -> tuple[float, float]:
    """Return records a second from the relay's inbox to the store of c2, and CPU time of each.

    The CPU time, in microseconds, is that of this process, which runs the relay.
    """
    relay = RelayService(platform(VESSEL, endpoint, folder), RelayConfig())
    peer = Relay(relay, key)
    peer.fill(payloads)
    tune_interpreter()
    with logged_to(folder / "relay.log", "info"):
        used_s = time.process_time()
        try:
            per_s = drained_per_s(peer, len(payloads))
            used_s = time.process_time() - used_s
        finally:
            relay.stop()
    return per_s, 1e6 * used_s / len(payloads)


def drained_per_s(peer: Peer, count: int) -> float:
    """Return records a second of a drain.

    Raises:
        StartError: Not all records have arrived.
    """
    drained = peer.drain(count)
    if drained.records != count:
        raise StartError(f"{type(peer).__name__}: {drained.records} of {count} records in {drained.seconds:.0f} s")
    return drained.per_s


@contextmanager
def logged_to(path: Path, level: str) -> Iterator[None]:
    """Log like a service, to a file in place of standard error."""
    with path.open("w", buffering=1) as file, redirect_stderr(file):
        configure_logging("relay", level)
        try:
            yield
        finally:
            logging.getLogger().handlers.clear()


def measure_fsyncs(folder: Path) -> float:
    """Return the number of sequential writes of 4 kB a second that reach the disk."""
    path = folder / "fsync"
    count = 0
    data = os.urandom(4096)
    with path.open("wb", buffering=0) as file:
        started = time.perf_counter()
        while time.perf_counter() - started < FSYNC_S:
            file.seek(0)
            file.write(data)
            os.fsync(file.fileno())
            count += 1
        elapsed_s = time.perf_counter() - started
    path.unlink()
    return count / elapsed_s


def measure(endpoint: str, folder: Path, records: Records, peers: Mapping[str, Peer]) -> dict[str, float]:
    """Measure all systems once."""
    rate, cpu_us = measure_relay(endpoint, folder, records.key, records.accepted)
    rates = {"sonarpost": rate, "zenoh": measure_bare(endpoint, records.sent)}
    for name, peer in peers.items():
        peer.fill(records.sent)
        rates[name] = drained_per_s(peer, len(records.sent))
    return {
        **{f"{name}_per_s": round(found) for name, found in rates.items()},
        **{f"of_{name}": round(rate / found, 2) for name, found in rates.items() if name != "sonarpost"},
        "relay_cpu_us": round(cpu_us),
        "fsync_per_s": round(measure_fsyncs(folder)),
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


def profile_relay(folder: Path, count: int) -> dict[str, object]:
    """Return the CPU time of each area of the relay for a coded image, in microseconds with the profiler."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    payloads = [wire.encode(coded_image(VESSEL, 1, n, time.time())) for n in range(count)]
    with running_far_side(endpoint, folder), profiled_threads() as profiles:
        measure_relay(endpoint, folder, keys.image_coded(VESSEL), payloads)
    totals = dict.fromkeys((*AREAS, "all"), 0.0)
    for profile in profiles:
        profile.create_stats()
        for (file, _, function), (_, _, own_s, with_callees_s, _) in profile.stats.items():
            totals["all"] += own_s
            for area, (path, name) in AREAS.items():
                if function == name and file.endswith(path):
                    totals[area] += with_callees_s
    return {area: round(1e6 * seconds / count, 1) for area, seconds in totals.items()}


@contextmanager
def running_far_side(endpoint: str, folder: Path) -> Iterator[None]:
    """Run the far side in a process of its own."""
    child = subprocess.Popen(
        [sys.executable, "-m", "research.relay_throughput", "--far-side", endpoint, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdin is not None
    try:
        if child.stdout.readline().strip() != "ready":
            sys.exit("relay_throughput: the far side did not start")
        yield
    finally:
        child.stdin.close()
        child.wait(timeout=10)


def compare(folder: Path, count: int, rounds: int, names: Sequence[str]) -> int:
    """Measure both kinds of records; return 1 if a ratio is below its aim."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    decisions = [wire.encode(decision(n)) for n in range(count)]
    images = [coded_image(VESSEL, 1, n, time.time()) for n in range(count)]
    kinds = {
        "decision": Records(keys.contact_decision(VESSEL), decisions, decisions),
        "coded image": Records(
            keys.image_coded(VESSEL), [*map(wire.encode, images)], [wire.encode(whole_part(one)) for one in images]
        ),
    }
    passed = True
    with ExitStack() as stack:
        peers: dict[str, Peer] = {}
        for name in names:
            (port,) = free_ports(1)
            try:
                peers[name] = stack.enter_context(PEERS[name](folder / name, port, port))
            except AbsentError as error:
                print(json.dumps({"skipped": name, "reason": str(error)}), flush=True)
        stack.enter_context(running_far_side(endpoint, folder))
        for kind, records in kinds.items():
            found = []
            for number in range(1, rounds + 1):
                found.append(measure(endpoint, folder, records, peers))
                print(json.dumps({"record": kind, "round": number, **found[-1]}), flush=True)
            medians = {name: round(statistics.median(one[name] for one in found), 2) for name in found[0]}
            size = round(statistics.mean(map(len, records.sent)))
            print(json.dumps({"record": kind, "median_of": rounds, "bytes": size, **medians}), flush=True)
            passed = passed and all(medians[f"of_{name}"] >= AIMS.get((kind, name), 0.0) for name in peers)
    return 0 if passed else 1


def main() -> int:
    """Run; return 1 if a ratio is below its aim."""
    parser = argparse.ArgumentParser(description="relay throughput against software of others that stores on disk")
    parser.add_argument("--records", type=int, default=10000, metavar="N", help="of each kind; default: 10000")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="default: 5")
    parser.add_argument(
        "--peers", default=",".join(PEERS), metavar="NAME,…", help="default: %(default)s; without any: --peers ''"
    )
    parser.add_argument("--dir", type=Path, metavar="DIR", help="folder for the stores (default: a temporary folder)")
    parser.add_argument("--profile", action="store_true", help="only the CPU time of the relay for coded images")
    parser.add_argument("--far-side", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.far_side:
        far_side(args.far_side[0], Path(args.far_side[1]))
        return 0
    names = [name for name in args.peers.split(",") if name]
    if unknown := set(names) - set(PEERS):
        parser.error(f"--peers: got {', '.join(sorted(unknown))}, expected some of {', '.join(PEERS)}")
    with ProgressDisplay(step="relay_throughput"), tempfile.TemporaryDirectory(dir=args.dir) as name:
        folder = Path(name).resolve()
        if args.profile:
            print(json.dumps({"record": "coded image", "cpu_us": profile_relay(folder, args.records)}), flush=True)
            return 0
        return compare(folder, args.records, args.rounds, names)


if __name__ == "__main__":
    sys.exit(main())
