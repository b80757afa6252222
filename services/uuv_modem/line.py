"""The vehicle's end of the v1 link: its queue, its receiver and its seal, saved together. No thread, no modem."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgpack

from sonarpost import wire
from sonarpost.codec.interface import StreamHeader
from sonarpost.config import PlatformConfig
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link import migration
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
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES, unpack_mini
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.link.receiver import FeedbackReceived, FrameRejected, MessageReceived
from sonarpost.link.sender import ImageToSend, OutgoingPacket
from sonarpost.link.state import below, prefixed, unpack_plain
from sonarpost.logs import kv
from sonarpost.messages import EncodedImage, OutgoingMessage
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.line_store import LineStore
from sonarpost.services.uuv_modem.orders import CommandRecord, ReceivedCommands

log = logging.getLogger(__name__)

_CONFIRMATION_PRIORITY: Final = 2
_CONFIRMATION_LIFETIME_S: Final = 900.0
_OWN: Final = "uuv_modem"
_QUEUE, _RECEIVER, _COMMANDS, _AUTHENTICATION = "queue/", "receiver/", "orders", "authentication/"
_LIMIT: Final = "v1-seal-limit/"
IMAGES_ACCEPTED: Final = "images_accepted"
_OLD_QUEUE: Final = ("queue/core", "queue/picture/")

Summarise = Callable[[EncodedImage], ContactSummary]


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
        self.receiver = V1Receiver(protection=self.seal)
        self.orders = ReceivedCommands(platform_id, self._config)

    def _new_queue(self, first_block: int) -> TransmitQueue:
        return TransmitQueue(self._config.queue_config(), first_block=first_block, protection=self.seal)

    def load(self, platform_id: str, now: float) -> None:
        """Continue from the state of the last process; parts that cannot be read are logged and quarantined."""
        saved = self._parts.load()
        parts, reasons = _migrated(saved)
        reasons |= {_QUEUE + name: error for name, error in self.queue.restore(below(_QUEUE, parts)).items()}
        reasons |= {_RECEIVER + name: error for name, error in self.receiver.restore(below(_RECEIVER, parts)).items()}
        if self.seal is not None:
            errors = self.seal.restore(below(_AUTHENTICATION, parts))
            reasons |= {_AUTHENTICATION + name: error for name, error in errors.items()}
        if _COMMANDS in parts:
            try:
                self.orders.restore(unpack_plain(dict, parts[_COMMANDS], "uuv_modem state"))
            except BadInputError as error:
                reasons[_COMMANDS] = error
                self.orders = ReceivedCommands(platform_id, self._config)
        if reasons:
            for name, reason in reasons.items():
                log.error("Discarding an unreadable part of the link state", extra=kv(part=name, reason=str(reason)))
            self.count("states_discarded")
            self._parts.quarantine({name: str(reason) for name, reason in reasons.items() if name in saved})

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
            parts = self._export()
            self._parts.write(tx, parts)
        self._parts.wrote(parts)
        self._to_hand.clear()
        self._taken.clear()

    def _hand(self, tx: Transaction) -> None:
        for handed in self._to_hand:
            for consumer in handed.consumers:
                encoding = wire.encoding_of(type(handed.record))
                tx.send(handed.key, consumer, wire.encode(handed.record), encoding=encoding, priority=1)

    def _export(self) -> dict[str, bytes]:
        parts = {**prefixed(_QUEUE, self.queue.parts()), **prefixed(_RECEIVER, self.receiver.parts())}
        parts[_COMMANDS] = bytes(msgpack.packb(self.orders.export()))
        if self.seal is not None:
            parts |= prefixed(_AUTHENTICATION, self.seal.parts())
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
        if number_of_image(record.image_id) not in self.queue.sender.kept:
            self.images_accepted += 1
        summary = self._summarise(record)
        self.queue.add_image(ImageToSend(record.image_id, record.contact.contact_id, summary, record.stream), now)

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
                    case FrameRejected():
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
        self.queue.on_mini_feedback(block, needed, now, source)
        self.count("reports_received")

    def _report(self, event: FeedbackReceived, now: float) -> None:
        self.count("reports_received")
        try:
            self.queue.on_feedback(event.feedback, now, event.source)
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
        image_id = None if isinstance(order, RevisitMessage) else self.queue.image_id_of(order.number)
        outcome, handed = self.orders.take(source, order, image_id)
        self._outcomes.append((order.token, outcome))
        if handed is None:
            return
        self.count("orders_taken")
        log.info("Order taken", extra=kv(source=source, key=handed.key, outcome=outcome.name.lower()))
        # What is here already need not be asked of anybody.
        if isinstance(order, RefineMessage) and self.queue.refine(order.number, order.stream_bytes, now):
            return
        self._to_hand.append(handed)

    def _refused(self, event: FrameRejected) -> None:
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

    def choose(self, now: float) -> OutgoingPacket | None:
        """Choose the next packet; it is under way from then on, and must be saved before it is sent.

        Raises:
            HandoffError: No counters could be reserved for the seal.
            FrameError: The key is used up.
        """
        self._reserve_counters()
        return self.queue.next_packet(now)

    def _reserve_counters(self) -> None:
        if self.seal is None or (limit := self.seal.requested_limit) is None:
            return
        with self._store.transaction() as tx:
            tx.put_state(self._limit_name, str(limit).encode())
        self.seal.grant(limit)


def _migrated(saved: Mapping[str, bytes]) -> tuple[dict[str, bytes], dict[str, BadInputError]]:
    """Return the parts of this version, and why parts of version 0.1 were skipped."""
    parts, errors = dict(saved), dict[str, BadInputError]()
    if any(name.startswith(_OLD_QUEUE) for name in saved):
        old_queue = {name: parts.pop(name) for name in saved if name.startswith(_QUEUE) or name == "packet"}
        found, skipped = migration.queue_parts({name.removeprefix(_QUEUE): data for name, data in old_queue.items()})
        parts |= prefixed(_QUEUE, found)
        errors |= {name if name == "packet" else _QUEUE + name: error for name, error in skipped.items()}
    for name, prefix, convert in (
        ("heard", _RECEIVER, migration.v1_receiver_parts),
        ("seal", _AUTHENTICATION, migration.authentication_parts),
    ):
        if name in saved:
            try:
                parts |= prefixed(prefix, convert(saved[name]))
            except BadInputError as error:
                errors[name] = error
    return parts, errors
