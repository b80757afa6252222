"""The vehicle's end of the acoustic link: transmit queue, receiver, commands and authentication, saved together."""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import msgpack

from sonarpost.codec.interface import StreamHeader
from sonarpost.config import PlatformConfig
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.downlink.messages import (
    CommandOutcome,
    ConfirmationMessage,
    DataMessage,
    DecisionMessage,
    DownlinkCommand,
    PrioritiseMessage,
    RefineMessage,
    RevisitMessage,
    confirmations,
    number_of_image,
    pack,
    unpack,
)
from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.link.frames.contact_record import summary_of
from sonarpost.link.frames.paper.sender import PaperSender
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES, unpack_mini
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.link.receiver import FeedbackReceived, FrameRejected, MessageReceived
from sonarpost.link.sender import ImageSender, ImageToSend, OutgoingPacket
from sonarpost.link.state import SavedParts, below, prefixed, unpack_plain
from sonarpost.logs import IntervalLog, kv
from sonarpost.messages import EncodedImage, OutgoingMessage, QueuedImage, QueueState
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.received_commands import ReceivedCommands

log = logging.getLogger(__name__)

_CONFIRMATION_PRIORITY: Final = 2
_CONFIRMATION_LIFETIME_S: Final = 900.0
_COMMAND_PRIORITY: Final = 1
_STATUS_PRIORITY: Final = 5
_MAX_IMAGES_PUBLISHED: Final = 500

# Names of the saved parts, below the name of the wire format.
_QUEUE, _RECEIVER, _COMMANDS, _AUTHENTICATION = "queue/", "receiver/", "commands", "authentication/"
_COUNTER_LIMIT: Final = "counter-limit/"
_IMAGES_ACCEPTED: Final = "images_accepted"
_PAPER: Final = "paper/"


class VehicleEndpoint:
    """State of the acoustic link on the vehicle, for both wire formats. It starts no thread and uses no modem.

    Several threads change it, each within `step`. A step ends with the commit of `take_changes`. If a step fails, the
    next one first reloads the state that was committed last.

    Attributes:
        queue: The transmit queue.
        authenticator: Authenticates frames, None without a key and with the `paper` format.
        images_accepted: Number of new images that were ever added.
        changed: Whether there are changes to commit.

    Args:
        platform: The vehicle.
        config: Configuration of the service.
        store: Holds the state.
        key: Authenticates frames; None for none. The `paper` format has no authentication.
        rejection_log: Logs rejected frames.
    """

    def __init__(
        self,
        platform: PlatformConfig,
        config: UuvModemConfig,
        store: Store,
        key: AcousticKey | None = None,
        rejection_log: IntervalLog | None = None,
    ) -> None:
        self._platform_id = platform.id
        self._config = config
        self._store = store
        self._is_v1 = config.link == "v1"
        self._prefix = f"{config.link}/"
        self._key = key
        self._rejection_log = rejection_log or IntervalLog(log, logging.WARNING, "Frame rejected")
        self._lock = threading.RLock()
        self._stale = True
        self._reset()

    def _reset(self) -> None:
        self.changed = False
        self.authenticator: FrameAuthenticator | None = None
        if self._key is not None:
            # The limit belongs to the key: another key starts at 0, and the old one continues when it is used again.
            self._limit_name = _COUNTER_LIMIT + self._key.fingerprint
            limit = int(self._store.get_state(self._limit_name) or b"0")
            address = self._config.address
            self.authenticator = FrameAuthenticator(self._key, address, Direction.FROM_VEHICLE, first_counter=limit)
        self.queue = self._new_queue()
        self.images_accepted = self._store.read_state(_IMAGES_ACCEPTED, int, 0)
        self._receiver = V1Receiver(protection=self.authenticator)
        self._commands = ReceivedCommands(self._platform_id, self._config)
        self._outcomes: list[tuple[int, CommandOutcome]] = []
        self._effects = UnitOfWork()
        self._saved = SavedParts({})

    def _new_queue(self) -> ImageSender:
        if not self._is_v1:
            return PaperSender(self._config.rate_info(self._config.rate))
        config, first_block = self._config.queue_config(), self._store.origin[0]
        return TransmitQueue(config, first_block=first_block, protection=self.authenticator)

    # Saved state

    @contextmanager
    def step(self) -> Iterator[None]:
        """Context manager for changes: locks the endpoint, and reloads the state if the last step failed."""
        with self._lock:
            if self._stale:
                self._load()
                self._stale = False
            try:
                yield
            except BaseException:
                self._stale = True
                raise

    def _load(self) -> None:
        self._reset()
        saved = self._store.states(self._prefix)
        self._saved = SavedParts(saved)
        errors: dict[str, BadInputError] = {}
        errors |= prefixed(_QUEUE, self.queue.restore(below(_QUEUE, saved)))
        errors |= prefixed(_RECEIVER, self._receiver.restore(below(_RECEIVER, saved)))
        if self.authenticator is not None:
            errors |= prefixed(_AUTHENTICATION, self.authenticator.restore(below(_AUTHENTICATION, saved)))
        if _COMMANDS in saved:
            try:
                self._commands.restore(unpack_plain(dict, saved[_COMMANDS], "uuv_modem state"))
            except BadInputError as error:
                errors[_COMMANDS] = error
        for name, reason in errors.items():
            self._discard(self._prefix + name, saved.get(name, b""), reason)
        if errors:
            self._effects.count("states_discarded")
        if self._is_v1:
            self._add_images_of_paper_queue()
        self.changed = True

    def _discard(self, name: str, data: bytes, reason: BadInputError) -> None:
        log.error("Discarding an unreadable part of the link state", extra=kv(part=name, reason=str(reason)))
        self._effects.quarantine(f"state {name}", data, str(reason))

    def _add_images_of_paper_queue(self) -> None:
        """Move images that still waited when the configuration changed from the `paper` format to `v1`."""
        parts = self._store.states(_PAPER)
        paper_queue = PaperSender(self._config.rate_info(self._config.rate))
        for name, reason in paper_queue.restore(below(_QUEUE, parts)).items():
            self._discard(_PAPER + _QUEUE + name, parts[_QUEUE + name], reason)
        for waiting in paper_queue.images:
            image = ImageToSend(waiting.image_id, waiting.contact_id, waiting.contact, waiting.stream)
            try:
                self._check_image(image)
                self.queue.add_image(image, 0.0)
            except BadInputError as error:
                self._discard(f"{_PAPER}{_QUEUE}image/{waiting.order}", image.stream, error)
        for name in parts:
            self._effects.delete_state(_PAPER + name)

    def take_changes(self) -> UnitOfWork:
        """Return what to commit in this step: the changed parts of the state, and new records for consumers."""
        parts = {**prefixed(_QUEUE, self.queue.parts()), **prefixed(_RECEIVER, self._receiver.parts())}
        parts[_COMMANDS] = bytes(msgpack.packb(self._commands.export()))
        if self.authenticator is not None:
            parts |= prefixed(_AUTHENTICATION, self.authenticator.parts())
        effects, self._effects = self._effects, UnitOfWork()
        effects.put_states(self._prefix, self._saved.changes(parts))
        self._saved.commit(parts)
        effects.put_state(_IMAGES_ACCEPTED, str(self.images_accepted).encode())
        self.changed = False
        return effects

    # Records of the vehicle's programs

    def check(self, record: EncodedImage | OutgoingMessage) -> None:
        """Check that the wire format can carry a record. Needs no step and does not wait.

        Raises:
            BadInputError: Names the invalid field.
        """
        if isinstance(record, EncodedImage):
            self._check_image(image_to_send(record))

    def _check_image(self, image: ImageToSend) -> None:
        if not self._is_v1:
            PaperSender(self._config.rate_info(self._config.rate)).add_image(image, 0.0)
            return
        number_of_image(image.image_id)
        StreamHeader.unpack(image.stream)
        image.contact.pack()
        if len(image.stream) > MAX_STREAM_BYTES:
            raise FrameError("image", "stream", f"{len(image.stream)} bytes", f"at most {MAX_STREAM_BYTES}")

    def add(self, record: EncodedImage | OutgoingMessage, now: float) -> None:
        """Add a record to the transmit queue.

        Args:
            record: The record.
            now: UTC in seconds.

        Raises:
            BadInputError: As `check`, or another image that waits has the same number.
        """
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
        else:
            is_new = self.queue.image_id_of(number_of_image(record.image_id)) is None
            self.queue.add_image(image_to_send(record), now)
            self.images_accepted += is_new
        self.changed = True

    def add_status(self, status: StatusMessage, now: float, lifetime_s: float) -> None:
        """Add the vehicle's status to the transmit queue. It is sent once: a lost one is replaced by the next.

        Args:
            status: The status.
            now: UTC in seconds.
            lifetime_s: Time after which it is dropped; the next one replaces it.
        """
        self.queue.add_message(
            f"status-{uuid.uuid4().hex}",
            "uuv_modem status",
            pack(status),
            now,
            priority=_STATUS_PRIORITY,
            lifetime_s=lifetime_s,
            once=True,
        )
        self.changed = True

    # Frames received

    def receive(self, source: int, frame: bytes, now: float) -> None:
        """Process a frame that was sent to this vehicle.

        Args:
            source: Modem address of the sender.
            frame: The frame.
            now: UTC in seconds.
        """
        if not self._is_v1:
            return  # the `paper` format has no downlink
        for event in self._receiver.accept(source, frame, now):
            match event:
                case FeedbackReceived():
                    self._receive_feedback(event, now)
                case MessageReceived():
                    self._receive_message(event, now)
                case FrameRejected():
                    self._frame_rejected(event)
                case _:
                    log.debug("Event ignored", extra=kv(kind=type(event).__name__))
        self._confirm_commands(now)
        self.changed = True

    def receive_mini(self, source: int, bits: int, now: float) -> None:
        """Process a mini-packet: feedback on one block. With a key it is rejected, because it has no tag."""
        if not self._is_v1:
            return
        self.changed = True
        if self.authenticator is not None:
            self._effects.count("frames_forged")
            return
        block, missing = unpack_mini(bits)
        self.queue.on_mini_feedback(block, missing, now, source)
        self._effects.count("feedback_received")

    def _receive_feedback(self, event: FeedbackReceived, now: float) -> None:
        self._effects.count("feedback_received")
        try:
            self.queue.on_feedback(event.feedback, now, event.source)
        except FrameError as error:
            log.warning("Feedback ignored", extra=kv(source=event.source, reason=str(error)))

    def _receive_message(self, event: MessageReceived, now: float) -> None:
        try:
            content = unpack(event.data, f"message from modem {event.source}")
        except FrameError as error:
            self._effects.count("commands_rejected")
            log.warning("Message rejected", extra=kv(reason=str(error)))
            return
        if isinstance(content, (ConfirmationMessage, DataMessage, StatusMessage)):
            log.info("Message ignored", extra=kv(source=event.source, kind=type(content).__name__))
            return
        self._receive_command(event.source, content, now)

    def _receive_command(self, source: int, command: DownlinkCommand, now: float) -> None:
        image_id = None if isinstance(command, RevisitMessage) else self.queue.image_id_of(command.number)
        outcome, received = self._commands.accept(source, command, image_id)
        self._outcomes.append((command.token, outcome))
        if received is None:
            return
        self._effects.count("commands_received")
        log.info("Command received", extra=kv(source=source, key=received.key, outcome=outcome.name.lower()))
        if isinstance(command, DecisionMessage) and self._config.stop_on_decision:
            self._stop_or_resume(command, now)
        if isinstance(command, PrioritiseMessage):
            self.queue.prioritise(command.number, now, first=command.place == "first")
        # If the queue has more of the image, it sends this itself, and the command reaches no other service.
        if isinstance(command, RefineMessage) and self.queue.refine(command.number, command.stream_bytes, now):
            return
        for consumer in received.consumers:
            self._effects.send(received.key, consumer, received.record, priority=_COMMAND_PRIORITY)

    def _stop_or_resume(self, decision: DecisionMessage, now: float) -> None:
        """Stop the image of a final verdict, and queue the rest of it again when the verdict is withdrawn."""
        if not self._commands.is_latest_decision(decision):
            return
        if decision.is_final and self.queue.stop(decision.number):
            self._effects.count("images_stopped")
        elif not decision.is_final and self.queue.resume(decision.number, now):
            self._effects.count("images_resumed")

    def _frame_rejected(self, event: FrameRejected) -> None:
        forged = self.authenticator is not None and event.reason.field == "tag"
        replayed = self.authenticator is not None and event.reason.field == "counter"
        self._effects.count("frames_forged" if forged else "frames_replayed" if replayed else "frames_rejected")
        self._rejection_log.log(source=event.source, reason=str(event.reason))

    def _confirm_commands(self, now: float) -> None:
        """Queue the outcomes of received commands, several in one message.

        It is sent once: if it is lost, the vessel repeats the command, which is confirmed again.
        """
        outcomes, self._outcomes = self._outcomes, []
        for confirmation in confirmations(outcomes):
            self.queue.add_message(
                f"confirmation-{uuid.uuid4().hex}",
                "uuv_modem",
                pack(confirmation),
                now,
                priority=_CONFIRMATION_PRIORITY,
                lifetime_s=_CONFIRMATION_LIFETIME_S,
                once=True,
            )

    # Packets to send

    def next_packet(self, now: float) -> OutgoingPacket | None:
        """Return the packet to send, None if there is nothing to send. Commit the changes before it is sent.

        Raises:
            DeliveryError: No counters can be reserved for authentication.
            FrameError: All counters of the key are used.
        """
        self._reserve_counters()
        before = self.queue.in_flight
        packet = self.queue.next_packet(now)
        self.changed |= packet is not before
        return packet

    def _reserve_counters(self) -> None:
        if self.authenticator is None or (limit := self.authenticator.requested_limit) is None:
            return
        with self._store.transaction() as tx:
            tx.put_state(self._limit_name, str(limit).encode())
        self.authenticator.grant(limit)

    def packet_sent(self, frames: tuple[bytes, ...], interval_s: float) -> None:
        """Record that frames of the packet in flight were sent; see `ImageSender.sent`."""
        for image in self.queue.sent(frames, interval_s):
            self._effects.count("images_sent")
            fields = kv(vehicle=self._platform_id, image_id=image.image_id, contact_id=image.contact_id)
            log.info("Image sent", extra=fields)
        self.changed = True

    def queue_state(self, now: float) -> QueueState:
        """Return the committed state of the transmit queue.

        Raises:
            DeliveryError: The state cannot be reloaded.
        """
        with self.step():
            queue, expected = self.queue, self.queue.expected(now)
            images = tuple(
                QueuedImage(
                    image_id=image.image_id,
                    contact_id=image.contact_id,
                    bytes_left=image.bytes_left,
                    preview_utc_s=image.preview_s,
                    expected_utc_s=image.done_s,
                )
                for image in expected[:_MAX_IMAGES_PUBLISHED]
            )
            return QueueState(
                platform_id=self._platform_id,
                time_utc_s=now,
                rate=queue.rate,
                frame_loss=queue.measured_loss,
                packet_interval_s=min(queue.packet_interval_s, 86400.0),
                messages_waiting=queue.messages_waiting,
                message_bytes=queue.message_bytes,
                images_waiting=len(expected),
                images=images,
                images_accepted=self.images_accepted,
            )


def image_to_send(record: EncodedImage) -> ImageToSend:
    """Return an encoded image as the transmit queue takes it."""
    contact = summary_of(record.contact, record.height_px, record.width_px)
    return ImageToSend(record.image_id, record.contact.contact_id, contact, record.stream)
