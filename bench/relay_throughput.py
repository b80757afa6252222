"""Relay throughput, as a ratio to bare acknowledged Zenoh queries in the same run, and to what the disk can do.

    python bench/relay_throughput.py [--decisions 5000] [--pictures 1000] [--dir DIR]

Three processes: a router, the far side, and this one. For records of two sizes (a decision, and a picture of 100 x 300
px) it measures

- bare: queries with the same bytes through the router to a queryable that answers at once and stores nothing, with as
  many in flight as the relay has;
- relay: a RelayService with the records in its inbox, on the disk: it puts each into its outbox, hands it over to a c2
  that commits it, and forgets it; until both its tables are empty. The far side is a durable c2 that does nothing else
  with a record ("sink"), so that what is measured is the hand-off and not the writing of TIFF files;
- disk: how often a second a 4 kB write to the same folder reaches the disk, and how many bytes a second do, 2 MB at a
  time. From both follows the bound: every record is committed three times (outbox, c2's inbox, forgotten), at most 64
  with one write, and its bytes are written four times (the log and the table of either side).

One JSON object a line. The exit status is 0 where the relay reaches half of the bare rate, or half of the disk's bound.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import zenoh

from services.relay.config import RelayConfig
from services.relay.service import RelayService
from sonarpost import keys, wire
from sonarpost.cli.demo.settings import free_ports
from sonarpost.messages import Decision, Raster, ReconstructedImage, Record, Relayed
from sonarpost.runtime.config import PlatformConfig, ServiceConfig
from sonarpost.runtime.schedule import CHUNK_BYTES, WINDOW, WINDOW_BYTES
from sonarpost.runtime.service import Effects, Service
from sonarpost.runtime.session import client_config, router_config

GOAL = 0.5
COMMITS, WRITES = 3, 4
BULK_BYTES = 2_000_000
VESSEL = "vessel-1"
BARE_KEY = "bench/bare"


class Sink(Service[ServiceConfig]):
    """A c2 that commits records and does nothing else with them."""

    NAME = "c2"
    BATCH = 64

    def consumes(self) -> Mapping[str, type[Record]]:
        """What vessels relay."""
        return {keys.shore_inbox_all(): Relayed}

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Nothing: the record is on the disk already."""


def far_side(endpoint: str, folder: Path) -> None:
    """Router, sink and bare queryable, until standard input ends."""
    router = zenoh.open(router_config([endpoint]))
    sink = Sink(platform("shore-1", endpoint, folder), ServiceConfig())
    sink.start()
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
    """Return a platform of this bench."""
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


def picture(number: int) -> ReconstructedImage:
    """Return a picture of 100 x 300 px, 30 kB."""
    pixels = np.random.default_rng(number).integers(0, 256, (100, 300), dtype=np.uint8)
    raster = Raster.from_array(pixels)
    return ReconstructedImage(
        vessel_id=VESSEL,
        vehicle_id="uuv-1",
        image_id=f"{number:04d}",
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
        first_frame_utc_s=float(number),
        last_frame_utc_s=float(number),
    )


def measure_bare(endpoint: str, payloads: list[bytes]) -> float:
    """Return records a second of plain acknowledged queries, in pieces as the relay's are."""
    session = zenoh.open(client_config([endpoint]))
    querier = session.declare_querier(BARE_KEY)
    while not querier.matching_status.matching:
        time.sleep(0.01)
    window = max(1, min(WINDOW, WINDOW_BYTES // max(len(payloads[0]), 1)))
    in_flight: deque[zenoh.handlers.Handler[zenoh.Reply]] = deque()
    started = time.perf_counter()
    for payload in payloads:
        for offset in range(0, len(payload), CHUNK_BYTES):
            if len(in_flight) >= window:
                in_flight.popleft().recv()
            piece = payload[offset : offset + CHUNK_BYTES]
            in_flight.append(
                session.get(BARE_KEY, payload=piece, timeout=5, congestion_control=zenoh.CongestionControl.BLOCK)
            )
    while in_flight:
        in_flight.popleft().recv()
    seconds = time.perf_counter() - started
    session.close()
    return len(payloads) / seconds


def measure_relay(endpoint: str, folder: Path, key: str, payloads: list[bytes]) -> float:
    """Return records a second from the relay's inbox to c2's store, acknowledged and forgotten."""
    relay = RelayService(platform(VESSEL, endpoint, folder), RelayConfig())
    with relay.store.transaction() as tx:
        for payload in payloads:
            tx.accept(key, payload)
    started = time.perf_counter()
    relay.start()
    try:
        while relay.delivered_to("c2") < len(payloads) or relay.store.outbox_depth():
            time.sleep(0.005)
        seconds = time.perf_counter() - started
    finally:
        relay.stop()
    return len(payloads) / seconds


def measure_disk(folder: Path, size: int, seconds: float = 1.0) -> float:
    """Return how many writes of `size` bytes a second reach the disk one after the other."""
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
        took = time.perf_counter() - started
    path.unlink()
    return count / took


def main() -> int:
    """Run; return 1 if a rate is below the goal."""
    parser = argparse.ArgumentParser(description="relay throughput against bare acknowledged queries")
    parser.add_argument("--decisions", type=int, default=5000, metavar="N", help="default: 5000")
    parser.add_argument("--pictures", type=int, default=1000, metavar="N", help="default: 1000")
    parser.add_argument("--dir", type=Path, metavar="DIR", help="where the stores are (default: a temporary folder)")
    parser.add_argument("--far-side", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.far_side:
        far_side(args.far_side[0], Path(args.far_side[1]))
        return 0
    with tempfile.TemporaryDirectory(dir=args.dir) as name:
        return compare(Path(name), args.decisions, args.pictures)


def compare(folder: Path, decisions: int, pictures: int) -> int:
    """Measure both kinds of records; return 1 if a rate is below the goal."""
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    child = subprocess.Popen(
        [sys.executable, __file__, "--far-side", endpoint, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert child.stdout is not None
    assert child.stdin is not None
    good = True
    try:
        if child.stdout.readline().strip() != "ready":
            sys.exit("relay_throughput: the far side did not start")
        kinds: list[tuple[str, str, list[bytes]]] = [
            ("decision", keys.contact_decision(VESSEL), [wire.encode(decision(n)) for n in range(decisions)]),
            ("picture", keys.image_reconstructed(VESSEL), [wire.encode(picture(n)) for n in range(pictures)]),
        ]
        for name, key, payloads in kinds:
            bare_before = measure_bare(endpoint, payloads)
            relayed = measure_relay(endpoint, folder, key, payloads)
            bare_after = measure_bare(endpoint, payloads)
            bare = (bare_before + bare_after) / 2
            fsyncs, bulk = measure_disk(folder, 4096), measure_disk(folder, BULK_BYTES) * BULK_BYTES
            bound = 1 / (COMMITS / (Sink.BATCH * fsyncs) + WRITES * len(payloads[0]) / bulk)
            result = {
                "record": name,
                "records": len(payloads),
                "bytes": len(payloads[0]),
                "bare_per_s": round(bare),
                "relay_per_s": round(relayed),
                "ratio": round(relayed / bare, 3),
                "relay_mb_per_s": round(relayed * len(payloads[0]) / 1e6, 2),
                "fsync_per_s": round(fsyncs),
                "disk_mb_per_s": round(bulk / 1e6),
                "disk_bound_per_s": round(bound),
                "of_disk_bound": round(relayed / bound, 2),
            }
            good = good and relayed >= GOAL * min(bare, bound)
            print(json.dumps(result), flush=True)
    finally:
        child.stdin.close()
        child.wait(timeout=10)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
