"""A vessel's relay whose routers reach shore sites over emulated links, and the drain of its records."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from unittest.mock import patch

import zenoh
from typing_extensions import override

from research.common.link_emulator import LinkEmulator
from research.common.ports import free_ports
from research.fleet import open_session, wait_until_alive
from research.relay_throughput import VESSEL, Sink, decision, platform
from sonarpost import keys, wire
from sonarpost.bus.session import router_config
from sonarpost.config import ServiceConfig
from sonarpost.delivery.records import OutboxItem, ReceivedChunk
from sonarpost.delivery.transaction import Transaction
from sonarpost.messages import CodedImage, ImagePart, Record, Relayed
from sonarpost.runtime.service import UnitOfWork
from sonarpost.services.relay.config import RelayConfig, UpstreamOptions
from sonarpost.services.relay.service import RelayService

DELAY_S = 0.3
"""One way, of all hops together."""
FIRST_S = 0.1
"""Records that arrive this soon after the first one came with it, and do not count for the rate."""
POLL_S = 0.01


@dataclass(frozen=True)
class Link:
    """Properties of the way to a site."""

    rate_bytes_per_s: int
    hops: int
    buffer_bytes: int

    def emulate(self, stack: ExitStack, port: int, between: Callable[[int], int] = int) -> list[LinkEmulator]:
        """Return the links to a port, the nearest to it first; `between` returns a port that leads to a link."""
        links: list[LinkEmulator] = []
        for _ in range(self.hops):
            delay_s, target = DELAY_S / self.hops, between(links[-1].port) if links else port
            link = LinkEmulator(
                target, rate_bytes_per_s=self.rate_bytes_per_s, delay_s=delay_s, buffer_bytes=self.buffer_bytes
            )
            stack.callback(link.close)
            links.append(link)
        return links


class TimedSink(Sink):
    """The c2 of a site, which keeps the times of arrival."""

    def __init__(self, site: str, endpoint: str, folder: Path) -> None:
        super().__init__(platform(f"{site}-c2", endpoint, folder), ServiceConfig())
        self._site = site
        self.arrivals_s: list[float] = []

    @override
    def consumed_keys(self) -> dict[str, type[Record]]:
        """Return the records of the relays for this site."""
        return {keys.shore_inbox_all(self._site): Relayed, keys.shore_part_all(self._site): ImagePart}

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Note the time."""
        self.arrivals_s.append(time.monotonic())


class TimedRelay(RelayService):
    """A relay that keeps the times at which decisions were queued, and removed after their acknowledgement."""

    def __init__(self, endpoint: str, folder: Path, sites: Sequence[str]) -> None:
        upstreams = tuple(UpstreamOptions(site=site) for site in sites)
        super().__init__(platform(VESSEL, endpoint, folder), RelayConfig(upstreams=upstreams))
        self.queued_s: list[float] = []
        self.removed_s: list[float] = []

    def queue(self, key: str, *payloads: bytes) -> None:
        """Put records into the inbox."""
        with self.store.transaction() as tx:
            for payload in payloads:
                tx.accept(key, payload)

    def queue_decision(self) -> None:
        """Put a decision into the inbox."""
        self.queued_s.append(time.monotonic())
        self.queue(keys.contact_decision(VESSEL), wire.encode(decision(len(self.queued_s))))

    @override
    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> bool:
        """Note the time of a decision."""
        if item.key == keys.shore_inbox(VESSEL):
            self.removed_s.append(time.monotonic())
        return super().on_acknowledged(tx, item, reason)


@dataclass
class Drain:
    """Result of a drain to one receiver.

    Attributes:
        records: Images that have arrived.
        seconds: From the start to the acknowledgement of the last record.
        arriving_s: From the first arrival to the last one.
        later: Records that have not arrived together with the first one.
        wire_bytes: What the first hop has carried to the receiver, and back.
        again: Records that the receiver was sent after it had accepted them.
        decisions_s: Time to the acknowledgement of each decision.
    """

    records: int
    seconds: float
    arriving_s: float
    later: int
    wire_bytes: Sequence[int]
    again: int = 0
    decisions_s: Sequence[float] = ()


@dataclass
class Vessel:
    """A relay, which is not started, with the links of each site (the nearest to it first) and the first site's c2."""

    relay: TimedRelay
    links: list[list[LinkEmulator]]
    sink: TimedSink
    again: list[str]

    def drain(self, count: int, timeout_s: float, events: Sequence[tuple[float, Callable[[], object]]] = ()) -> Drain:
        """Start the relay; return when the first site has acknowledged all records, or after the time-out.

        Args:
            count: Number of images.
            timeout_s: From the start.
            events: What to do, each at a time after the start.
        """
        before, started_s, waiting = passed(self.links[0]), time.monotonic(), list(events)
        self.relay.start()
        while (elapsed_s := time.monotonic() - started_s) < timeout_s:
            if self.relay.acknowledged_count("c2") >= count + len(self.relay.queued_s) and not waiting:
                break
            if waiting and elapsed_s >= waiting[0][0]:
                waiting.pop(0)[1]()
            time.sleep(POLL_S)
        arrivals_s = list(self.sink.arrivals_s)
        first_s, last_s = (arrivals_s[0], arrivals_s[-1]) if arrivals_s else (0.0, 0.0)
        return Drain(
            len(arrivals_s) - len(self.relay.removed_s),
            elapsed_s,
            last_s - first_s,
            sum(at_s > first_s + FIRST_S for at_s in arrivals_s),
            [after - earlier for after, earlier in zip(passed(self.links[0]), before, strict=True)],
            len(self.again),
            [end_s - at_s for at_s, end_s in zip(self.relay.queued_s, self.relay.removed_s, strict=False)],
        )


def passed(links: Sequence[LinkEmulator]) -> list[int]:
    """Return the bytes that the first hop has carried to the shore and back."""
    return list(links[-1].passed_bytes.values())


@contextmanager
def vessel(link: Link, images: Sequence[CodedImage], sites: Sequence[str] = (keys.SHORE,)) -> Iterator[Vessel]:
    """Start routers, links and c2 of each site; put images into the inbox of the relay."""
    again: list[str] = []
    was_received = Transaction.was_received

    def counted(tx: Transaction, key: str, chunk: ReceivedChunk) -> bool:
        found = was_received(tx, key, chunk)
        again.extend([key] * found)
        return found

    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        stack.enter_context(patch.object(Transaction, "was_received", counted))

        def start_router(*upstreams: int) -> int:
            (port,) = free_ports(1)
            connect = [endpoint_of(upstream) for upstream in upstreams]
            stack.enter_context(zenoh.open(router_config([endpoint_of(port)], connect)))
            return port

        sinks, links = [], []
        for site in sites:
            port = start_router()
            sinks.append(TimedSink(site, endpoint_of(port), Path(folder)))
            sinks[-1].start()
            stack.callback(sinks[-1].stop)
            links.append(link.emulate(stack, port, start_router))
        endpoint = endpoint_of(start_router(*(one[-1].port for one in links)))
        relay = TimedRelay(endpoint, Path(folder), sites)
        stack.callback(relay.stop)
        for one in chain.from_iterable(links):
            stack.callback(one.cut)  # a router does not close while data waits for a stalled link
        relay.queue(keys.image_coded(VESSEL), *map(wire.encode, images))
        with open_session(endpoint) as session:
            wait_until_alive(session, {keys.alive(f"{site}-c2", "c2") for site in sites}, 60.0)
        yield Vessel(relay, links, sinks[0], again)


def endpoint_of(port: int) -> str:
    """Return the Zenoh endpoint of a port of this host."""
    return f"tcp/127.0.0.1:{port}"
