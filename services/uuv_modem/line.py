"""The vehicle's end of the v1 link: its queue, its receiver and its seal, saved together. No thread, no modem."""

from __future__ import annotations

import logging
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from sonarpost import wire
from sonarpost.codec.interface import StreamHeader
from sonarpost.config import PlatformConfig
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.downlink.messages import (
    CommandOutcome,
    ConfirmationMessage,
    DataMessage,
    DownlinkCommand,
    RefineMessage,
    RevisitMessage,
    confirmations,
    number_of_image,
    pack,
    unpack,
)
from sonarpost.link.events import FeedbackReceived, FrameRefused, MessageReceived
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.feedback import unpack_mini
from sonarpost.link.frames.v1.frame import BLOCKS
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES
from sonarpost.link.queue.state import export_queue, restore_queue, salvage_queue
from sonarpost.link.queue.transmit_queue import ImageName, TransmitQueue
from sonarpost.link.receiver import LinkReceiver
from sonarpost.logs import kv
from sonarpost.messages import EncodedImage, OutgoingMessage
from sonarpost.modem.micromodem import RATES
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.line_store import LineStore
from sonarpost.services.uuv_modem.orders import CommandRecord, ReceivedCommands

log = logging.getLogger(__name__)

_CONFIRMATION_PRIORITY: Final = 2
_CONFIRMATION_LIFETIME_S: Final = 900.0
_OWN: Final = "uuv_modem"
_QUEUE, _HEARD, _ORDERS, _PACKET, _SEAL = "queue/", "heard", "orders", "packet", "seal"
_LIMIT: Final = "v1-seal-limit/"
IMAGES_ACCEPTED: Final = "images_accepted"

Summarise = Callable[[EncodedImage], ContactSummary]


@dataclass(frozen=True, slots=True)
class PendingPacket:
    """A packet that was chosen and has not gone, as far as is known."""

    rate: int
    frames: tuple[bytes, ...]


class VehicleEndpoint:
    """What of the v1 link has to be kept, and every change of it that is kept together.

    Args:
        platform: The vehicle.
        config: The service's.
        store: Where the state is.
        summarise: Makes the record of a contact that travels by sound.
        count: Adds to a health counter.

    Raises:
        ConfigError: The key file cannot be read or is not the owner's alone.
    """

    def __init__(
        self,
        platform: PlatformConfig,
        config: UuvModemConfig,
        store: Store,
        summarise: Summarise,
        count: Callable[[str], None],
    ) -> None:
        self._config = config
        self._store = store
        self._summarise = summarise
        self.count = count
        self._parts = LineStore(store)
        self.seal = self._new_seal(platform)
        self.under_way: PendingPacket | None = None
        self._to_hand: list[CommandRecord] = []
        self._outcomes: list[tuple[int, CommandOutcome]] = []
        self._taken: list[str] = []
        self.images_accepted = int(store.get_state(IMAGES_ACCEPTED) or b"0")
        self._begin_anew(platform.id)

    def _new_seal(self, platform: PlatformConfig) -> FrameAuthenticator | None:
        if platform.acoustic_key_file is None:
            return None
        key = read_key(platform.acoustic_key_file)
        # A limit belongs to its key: with another key the counters begin at 0 again, and come back with the old one.
        self._limit_name = _LIMIT + key.fingerprint
        limit = int(self._store.get_state(self._limit_name) or b"0")
        return FrameAuthenticator(key, self._config.address, Direction.FROM_VEHICLE, first_counter=limit)

    def _begin_anew(self, platform_id: str) -> None:
        first_block = self._store.origin[0]
        self.queue = self._new_queue(first_block)
        self.receiver = LinkReceiver(seal=self.seal)
        self.orders = ReceivedCommands(platform_id, self._config)
        self.under_way = None

    def _new_queue(self, first_block: int) -> TransmitQueue:
        return TransmitQueue(self._config.queue_config(), first_block=first_block, seal=self.seal)

    def load(self, platform_id: str, now: float) -> None:
        """Go on where the last process was.

        What cannot be read is logged and kept apart as it is; pictures and messages are put into a new queue again.
        """
        parts, unreadable = self._parts.load()
        if not parts and not unreadable:
            return
        queue_parts = {n.removeprefix(_QUEUE): part for n, part in parts.items() if n.startswith(_QUEUE)}
        reasons = {name: f"{len(data)} bytes that are no msgpack map" for name, data in unreadable.items()}
        try:
            restore_queue(self.queue, queue_parts)
        except BadInputError as error:
            reasons[_QUEUE + "core"] = str(error)
            # Another first block, so that receivers do not take new blocks for those they know.
            self.queue = self._new_queue(secrets.randbelow(BLOCKS))
            saved, refused = salvage_queue(self.queue, queue_parts, now)
            reasons |= {_QUEUE + each.where.rpartition(": ")[2]: str(each) for each in refused}
            log.error("The queue is made anew of its pictures and messages", extra=kv(saved=saved))
        reasons |= self._load_others(parts, platform_id)
        if reasons:
            for name, reason in reasons.items():
                log.error("A part of the link's state cannot be read", extra=kv(part=name, reason=reason))
            self.count("states_discarded")
            self._parts.quarantine(reasons)

    def _load_others(self, parts: Mapping[str, Mapping[str, object]], platform_id: str) -> dict[str, str]:
        """Take up what is kept beside the queue; return why, by part, where that cannot be."""
        reasons: dict[str, str] = {}
        try:
            self.receiver.restore(parts.get(_HEARD, {}))
        except BadInputError as error:
            reasons[_HEARD] = str(error)
        try:
            self.orders.restore(parts.get(_ORDERS, {}))
        except BadInputError as error:
            reasons[_ORDERS] = str(error)
            self.orders = ReceivedCommands(platform_id, self._config)
        match parts.get(_PACKET, {}):
            case {"rate": int(rate), "frames": [*listed]} if rate in RATES:
                frames = tuple(frame for frame in listed if isinstance(frame, bytes))
                self.under_way = PendingPacket(rate, frames) if frames else None
        seal_state = parts.get(_SEAL)
        try:
            if self.seal is not None and seal_state and seal_state.get("key") == self.seal.snapshot()["key"]:
                self.seal.restore(seal_state)
        except BadInputError as error:
            reasons[_SEAL] = str(error)
        return reasons

    def save(self) -> None:
        """Write what has changed, records for consumers included, in one transaction.

        Raises:
            HandoffError: The disk refused; nothing was written, and a later call writes it all.
        """
        with self._store.transaction() as tx:
            self._hand(tx)
            for name in self._taken:
                tx.delete_state(name)
            tx.put_state(IMAGES_ACCEPTED, str(self.images_accepted).encode())
            digests = self._parts.write(tx, self._export())
        self._parts.wrote(digests)
        self._to_hand.clear()
        self._taken.clear()

    def _hand(self, tx: Transaction) -> None:
        for handed in self._to_hand:
            for consumer in handed.consumers:
                encoding = wire.encoding_of(type(handed.record))
                tx.send(handed.key, consumer, wire.encode(handed.record), encoding=encoding, priority=1)

    def _export(self) -> dict[str, dict[str, object]]:
        packet = self.under_way
        parts = {_QUEUE + name: dict(part) for name, part in export_queue(self.queue).items()}
        parts[_HEARD] = self.receiver.snapshot()
        parts[_ORDERS] = self.orders.export()
        parts[_PACKET] = {"rate": packet.rate, "frames": list(packet.frames)} if packet else {}
        if self.seal is not None:
            parts[_SEAL] = self.seal.snapshot()
        return parts

    # From the vehicle's programs

    def check(self, record: EncodedImage | OutgoingMessage) -> None:
        """Refuse what can never be sent.

        Raises:
            BadInputError: Names the field.
        """
        if isinstance(record, EncodedImage):
            number_of_image(record.image_id)
            StreamHeader.unpack(record.stream)
            self._summarise(record).pack()
            if len(record.stream) > MAX_STREAM_BYTES:
                raise FrameError("picture", "stream", f"{len(record.stream)} bytes", f"at most {MAX_STREAM_BYTES}")

    def accept(self, name: str, record: EncodedImage | OutgoingMessage, now: float) -> None:
        """Put an accepted record into the queue; `name` is its place in the store until that is saved.

        Raises:
            BadInputError: As `check`; its place is given up with the next `save`.
        """
        self._taken.append(name)
        if isinstance(record, OutgoingMessage):
            left_s = min(record.created_utc_s + record.lifetime_s - now, record.lifetime_s)
            self.queue.add_message(
                record.message_id,
                record.source,
                pack(DataMessage(record.data)),
                now,
                priority=record.priority,
                lifetime_s=left_s,
            )
            return
        number = number_of_image(record.image_id)
        if number not in self.queue.sender.kept:
            self.images_accepted += 1
        name_of_it = ImageName(record.image_id, record.contact.contact_id)
        self.queue.add_picture(number, name_of_it, self._summarise(record), record.stream, now)

    def accepted(self, most: int = 64) -> list[tuple[str, bytes]]:
        """Return records that are not in the queue yet."""
        taken = set(self._taken)
        return [item for item in self._parts.arrivals(most + len(taken)) if item[0] not in taken]

    def arrival_name(self) -> str:
        """See `LineStore.arrival_name`."""
        return self._parts.arrival_name()

    # From the water

    def hear(self, source: int, frames: Sequence[bytes], now: float) -> None:
        """Act on frames that came for this vehicle; `save` makes it last."""
        for frame in frames:
            for event in self.receiver.accept(source, frame, now):
                match event:
                    case FeedbackReceived():
                        self._report(event, now)
                    case MessageReceived():
                        self._message(event, now)
                    case FrameRefused():
                        self._refused(event)
                    case _:
                        log.debug("Not for a vehicle: %s", type(event).__name__)
        self._confirm(now)

    def hear_mini(self, source: int, bits: int, now: float) -> None:
        """Act on a mini-packet, the least form of a report; with a key, nobody vouches for it."""
        if self.seal is not None:
            self.count("frames_forged")
            return
        block, needed = unpack_mini(bits)
        self.queue.on_mini(block, needed, now, source)
        self.count("reports_received")

    def _report(self, event: FeedbackReceived, now: float) -> None:
        self.count("reports_received")
        try:
            self.queue.on_report(event.report, now, event.source)
        except FrameError as error:
            log.warning("Report of no use", extra=kv(source=event.source, reason=str(error)))

    def _message(self, event: MessageReceived, now: float) -> None:
        where = f"message from modem {event.source}"
        try:
            content = unpack(event.data, where)
        except FrameError as error:
            self.count("orders_refused")
            log.warning("Message refused", extra=kv(reason=str(error)))
            return
        if isinstance(content, (ConfirmationMessage, DataMessage)):
            log.info("Message of no use to a vehicle", extra=kv(source=event.source, kind=type(content).__name__))
            return
        self._order(event.source, content, now)

    def _order(self, source: int, order: DownlinkCommand, now: float) -> None:
        known = None if isinstance(order, RevisitMessage) else self.queue.names.get(order.number)
        outcome, handed = self.orders.take(source, order, known.image_id if known else None)
        self._outcomes.append((order.token, outcome))
        if handed is None:
            return
        self.count("orders_taken")
        log.info("Order taken", extra=kv(source=source, key=handed.key, outcome=outcome.name.lower()))
        # What is here already need not be asked of anybody.
        if isinstance(order, RefineMessage) and self.queue.refine(order.number, order.stream_bytes, now):
            return
        self._to_hand.append(handed)

    def _refused(self, event: FrameRefused) -> None:
        reason = event.reason
        forged = self.seal is not None and reason.field == "tag"
        replayed = self.seal is not None and reason.field == "counter"
        self.count("frames_forged" if forged else "frames_replayed" if replayed else "frames_refused")
        log.warning("Frame refused", extra=kv(source=event.source, reason=str(reason)))

    def _confirm(self, now: float) -> None:
        """Owe the vessel what became of its orders: few short messages for all of them."""
        outcomes, self._outcomes = self._outcomes, []
        for confirmation in confirmations(outcomes):
            self.queue.add_message(
                f"confirmation-{self.queue.messages.next_key}",
                _OWN,
                pack(confirmation),
                now,
                priority=_CONFIRMATION_PRIORITY,
                lifetime_s=_CONFIRMATION_LIFETIME_S,
            )

    # Into the water

    def choose(self, now: float, most_frames: int | None = None) -> PendingPacket | None:
        """Choose the next packet; it is under way from then on, and must be saved before it is sent.

        Raises:
            HandoffError: No counters could be reserved for the seal.
            FrameError: The key is used up.
        """
        assert self.under_way is None
        self._reserve_counters()
        frames = self.queue.next_packet(now, most_frames)
        if frames:
            self.under_way = PendingPacket(self.queue.rate, frames)
        return self.under_way

    def _reserve_counters(self) -> None:
        if self.seal is None or (limit := self.seal.wanted_limit) is None:
            return
        with self._store.transaction() as tx:
            tx.put_state(self._limit_name, str(limit).encode())
        self.seal.grant(limit)

    def gone(self, frames: Sequence[bytes]) -> None:
        """Note that frames of the packet under way have gone; the others stay under way."""
        if self.under_way is None:
            return
        left = tuple(frame for frame in self.under_way.frames if frame not in frames)
        self.under_way = PendingPacket(self.under_way.rate, left) if left else None
