"""`python -m research.thin_links`: drain of the relay over emulated links, without any setting of a bandwidth.

    python -m research.thin_links [--only drain,decision,cuts,sites] [--rates 2000,8000] [--hops 1,2] [--peers nats]

Coded images of 200 bytes wait in the inbox of a relay, which delivers them to a c2 that only commits them ("sink" of
`research.relay_throughput`). Between the vessel's router and the shore's router there are one or two links
(`research.common.link_emulator`), with a router between two. All have the same rate; the delay is 300 ms each way in
sum. The parts:

- drain: of 300 images, and of as many as occupy the link for 30 s, at each rate. With `--peers`, also by the durable
  software of others (`research.peers`), through the same links, with the same payloads;
- decision: time to the acknowledgement of decisions that are queued behind 1000 images at 8 kB/s;
- cuts: a drain at 8 kB/s while the connection is cut for 5 to 60 s at random times;
- sites: a drain to one of two sites while the link of the other one is a black hole, beside a drain to one site.

One JSON object a line:

- `seconds`: from the start to the acknowledgement of the last record (peers: until the receiver has stored it);
- `arriving_s`: from the first arrival to the last one (peers: as `seconds`);
- `wire_bytes`: what the link has carried to the shore, and back, TCP and IP not included;
- `bytes_a_record`: of both directions;
- `wire_of_payload`: bytes to the shore, divided by the payload;
- `payload_of_link`, `payload_of_link_arriving`: payload, divided by what the link can carry in `seconds`, in
  `arriving_s`;
- `again`: records that c2 received after it had accepted them.

The exit status is 0 if every record arrives once and the aims are met: in drains of 30 s and more, payload is at least
0.8 of what the link can carry from the first arrival on, with at most 1.15 bytes for each byte of payload, and nothing
arrives again; decisions are acknowledged within 3 s; the other site takes at most 1.1 of the time.
"""

import argparse
import json
import logging
import random
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import product
from pathlib import Path

from research.common.ports import free_ports
from research.fleet import coded_image
from research.linked_vessel import Drain, Link, passed, vessel
from research.peers import PEERS, AbsentError
from research.relay_throughput import VESSEL
from sonarpost import keys, wire
from sonarpost.archive.image_parts import whole_part
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.messages import CodedImage

RATES = (2000, 8000, 16_000, 32_000, 128_000)
STREAM_BYTES = 200
IMAGES, BUSY_S = 300, 30.0
SLOW_RATE, MANY_IMAGES = 8000, 1000
DECISIONS_AT_S = (2.0, 8.0, 14.0, 20.0)
CUTS, CUT_S, BETWEEN_CUTS_S = 3, (5.0, 60.0), (3.0, 12.0)
OTHER_SITE, STALL_AT_S = "shore-2", 3.0
SHARE, WIRE, DECISION_S, OTHER_TIME = 0.8, 1.15, 3.0, 1.1
MIN_TIMEOUT_S, TIMEOUT_FACTOR = 60.0, 4.0


def peer_drain(system: str, link: Link, payloads: Sequence[bytes], timeout_s: float) -> Drain:
    """Drain records by the durable software of others."""
    (port,) = free_ports(1)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        links = link.emulate(stack, port)
        peer = stack.enter_context(PEERS[system](Path(folder) / system, port, links[-1].port))
        peer.fill(payloads)
        before = passed(links)
        found = peer.drain(len(payloads), timeout_s)
        wire_bytes = [after - earlier for after, earlier in zip(passed(links), before, strict=True)]
    return Drain(found.records, found.seconds, found.seconds, found.records, wire_bytes)


def images_of(count: int) -> list[CodedImage]:
    """Return coded images as a vessel has received them; their streams cannot be compressed."""
    return [coded_image(VESSEL, 1, n, time.time(), random.Random(n).randbytes(STREAM_BYTES)) for n in range(count)]


def sent_payload(image: CodedImage) -> bytes:
    """Return what the relay sends to a site."""
    return wire.encode(whole_part(image))


class Bench:
    """Runs the parts; `passed` is whether all aims were met so far."""

    def __init__(self, hops: Sequence[int], buffer_bytes: int) -> None:
        self.passed = True
        self._hops = hops
        self._buffer_bytes = buffer_bytes
        self._slow = Link(SLOW_RATE, max(hops), buffer_bytes)

    def report(self, part: str, link: Link, *, good: bool, **result: object) -> None:
        """Print one object."""
        fields = {"part": part, "rate_bytes_per_s": link.rate_bytes_per_s, "hops": link.hops, **result, "good": good}
        print(json.dumps(fields), flush=True)
        self.passed &= good

    def drains(self, rates: Sequence[int], systems: Sequence[str]) -> None:
        """Drain by each system at each rate: a small backlog, and one that occupies the link."""
        for hops, rate in product(self._hops, rates):
            link = Link(rate, hops, self._buffer_bytes)
            busy_images = round(BUSY_S * rate / len(sent_payload(images_of(1)[0])))
            for images in sorted({IMAGES, max(IMAGES, busy_images)}):
                for system in systems:
                    self.drain(link, system, images, is_busy=images >= busy_images)

    def drain(self, link: Link, system: str, images: int, *, is_busy: bool) -> None:
        """Drain images by the relay or a peer."""
        records = images_of(images)
        sent = [sent_payload(record) for record in records]
        timeout_s = max(MIN_TIMEOUT_S, TIMEOUT_FACTOR * sum(map(len, sent)) / link.rate_bytes_per_s)
        if system == "sonarpost":
            with vessel(link, records) as one:
                found = one.drain(images, timeout_s)
        else:
            found = peer_drain(system, link, sent, timeout_s)
        size = sum(map(len, sent)) / images
        payload, up = found.records * size, found.wire_bytes[0]
        ratio = up / max(payload, 1)
        share = found.later * size / link.rate_bytes_per_s / found.arriving_s if found.arriving_s else 0.0
        meets = found.records == images and not found.again and (not is_busy or (share >= SHARE and ratio <= WIRE))
        self.report(
            "drain",
            link,
            system=system,
            images=images,
            arrived=found.records,
            payload_bytes=round(payload),
            seconds=round(found.seconds, 1),
            arriving_s=round(found.arriving_s, 1),
            wire_bytes=found.wire_bytes,
            bytes_a_record=round(sum(found.wire_bytes) / max(found.records, 1)),
            wire_of_payload=round(ratio, 3),
            payload_of_link=round(payload / link.rate_bytes_per_s / found.seconds, 3),
            payload_of_link_arriving=round(share, 3),
            again=found.again,
            good=meets or system != "sonarpost",
        )

    def decisions(self) -> None:
        """Queue decisions behind images."""
        with vessel(self._slow, images_of(MANY_IMAGES)) as one:
            events = [(at_s, one.relay.queue_decision) for at_s in DECISIONS_AT_S]
            took_s = one.drain(MANY_IMAGES, 2 * MIN_TIMEOUT_S, events).decisions_s
        good = len(took_s) == len(DECISIONS_AT_S) and max(took_s) <= DECISION_S
        self.report("decision", self._slow, acknowledged_s=[round(s, 2) for s in took_s], good=good)

    def cuts(self, seed: int) -> None:
        """Cut one hop after the other at random times."""
        rng = random.Random(seed)
        cut_s = [round(rng.uniform(*CUT_S), 1) for _ in range(CUTS)]
        with vessel(self._slow, images_of(MANY_IMAGES)) as one:
            events: list[tuple[float, Callable[[], object]]] = []
            at_s = 0.0
            for duration_s in cut_s:
                link = rng.choice(one.links[0])
                at_s += rng.uniform(*BETWEEN_CUTS_S)
                events += [(at_s, link.cut), (at_s + duration_s, link.mend)]
                at_s += duration_s
            found = one.drain(MANY_IMAGES, at_s + 3 * MIN_TIMEOUT_S, events)
        good = found.records == MANY_IMAGES
        fields = {"arrived": found.records, "seconds": round(found.seconds, 1), "wire_bytes": found.wire_bytes}
        self.report("cuts", self._slow, images=MANY_IMAGES, cut_s=cut_s, **fields, again=found.again, good=good)

    def sites(self) -> None:
        """Drain to one site, alone and while the link of another one is a black hole."""
        took_s, arrived = [], []
        for sites in ([keys.SHORE], [keys.SHORE, OTHER_SITE]):
            with vessel(self._slow, images_of(MANY_IMAGES), sites) as one:
                events = [(STALL_AT_S, link.stall) for links in one.links[1:] for link in links]
                found = one.drain(MANY_IMAGES, 3 * MIN_TIMEOUT_S, events)
            took_s.append(round(found.seconds, 1))
            arrived.append(found.records)
        good = arrived == [MANY_IMAGES] * 2 and took_s[1] <= OTHER_TIME * took_s[0]
        self.report("sites", self._slow, arrived=arrived, alone_s=took_s[0], beside_s=took_s[1], good=good)


def integers(text: str) -> tuple[int, ...]:
    """Return numbers that commas separate."""
    return tuple(int(one) for one in text.split(","))


def main() -> int:
    """Run; return 1 if an aim is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="drain,decision,cuts,sites", metavar="PART,PART", help="default: all parts")
    parser.add_argument("--rates", default=RATES, type=integers, metavar="N,N", help="bytes/s; default: 2000 to 128000")
    parser.add_argument("--hops", default=(1, 2), type=integers, metavar="N,N", help="links in series; default: 1,2")
    parser.add_argument("--peers", default="", metavar="NAME,NAME", help=f"of {', '.join(PEERS)}; default: none")
    parser.add_argument("--buffer", type=int, default=16384, metavar="N", help="bytes of each link; default: 16384")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the cuts; default: 0")
    args = parser.parse_args()
    logging.disable(logging.WARNING)  # links are cut on purpose
    bench = Bench(args.hops, args.buffer)
    parts: dict[str, Callable[[], None]] = {
        "drain": lambda: bench.drains(args.rates, ["sonarpost", *filter(None, args.peers.split(","))]),
        "decision": bench.decisions,
        "cuts": lambda: bench.cuts(args.seed),
        "sites": bench.sites,
    }
    for part in args.only.split(","):
        with ProgressDisplay(step=part):
            try:
                parts[part]()
            except AbsentError as error:
                sys.exit(f"thin_links: {error}")
    return 0 if bench.passed else 1


if __name__ == "__main__":
    sys.exit(main())
