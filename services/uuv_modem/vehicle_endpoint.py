"""The vehicle's end of the acoustic link: transmit queue, receiver, commands and authentication. It does no I/O."""

from __future__ import annotations

import logging
import uuid
from typing import Final

import msgpack

from sonarpost.codec.interface import StreamHeader
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.auth.authentication import FrameAuthenticator
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
from sonarpost.link.state import Parts, below, prefixed, unpack_plain
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

# Names of the saved parts.
_V1, _PAPER, _IMAGES_ACCEPTED = "v1/", "paper/", "images_accepted"
_QUEUE, _RECEIVER, _COMMANDS, _AUTHENTICATION = "queue/", "receiver/", "commands", "authentication/"


class VehicleEndpoint:
    """State of the acoustic link on the vehicle, for both wire formats. Not thread-safe.

    Attributes:
        queue: The transmit queue.
        authenticator: Authenticates frames, None without a key and with the `paper` format.
        images_accepted: Number of new images that were ever added.
        changed: Whether there are changes to commit.

    Args:
        platform_id: The vehicle.
        config: Configuration of the service.
        authenticator: Authenticates frames; None for none. The `paper` format has no authentication.
        first_block: See `V1Sender`.
        rejection_log: Logs rejected frames.
    """

    def __init__(
        self,
        platform_id: str,
        config: UuvModemConfig,
        authenticator: FrameAuthenticator | None = None,
        *,
        first_block: int = 0,
        rejection_log: IntervalLog | None = None,
    ) -> None:
        self._platform_id = platform_id
        self._config = config
        self._is_v1 = config.link == "v1"
        self._rejection_log = rejection_log or IntervalLog(log, logging.WARNING, "Frame rejected")
        self.authenticator = authenticator
        self.queue: ImageSender = PaperSender(config.rate_info(config.rate))
        if self._is_v1:
            self.queue = TransmitQueue(config.queue_config(), first_block=first_block, protection=authenticator)
        self.images_accepted = 0
        self.changed = False
        self._receiver = V1Receiver(protection=authenticator)
        self._commands = ReceivedCommands(platform_id, config)
        self._outcomes: list[tuple[int, CommandOutcome]] = []
        self._effects = UnitOfWork()
        self._v1_parts: dict[str, bytes] = {}  # saved parts of `v1` while the format is `paper`

    # Saved state

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`: each part below the name of its wire format."""
        parts = {_IMAGES_ACCEPTED: str(self.images_accepted).encode()}
        if not self._is_v1:
            return {**parts, **self._v1_parts, **prefixed(_PAPER + _QUEUE, self.queue.parts())}
        parts |= prefixed(_V1 + _QUEUE, self.queue.parts()) | prefixed(_V1 + _RECEIVER, self._receiver.parts())
        parts[_V1 + _COMMANDS] = bytes(msgpack.packb(self._commands.export()))
        if self.authenticator is not None:
            parts |= prefixed(_V1 + _AUTHENTICATION, self.authenticator.parts())
        return parts

    def restore(self, parts: Parts) -> dict[str, BadInputError]:
        """Replace the state of a new endpoint by saved parts; return why parts were skipped.

        After a change from the `paper` format to `v1`, the images that still waited are moved. After a change from `v1`
        to `paper`, its state is kept.
        """
        self.changed = True
        errors: dict[str, BadInputError] = {}
        try:
            self.images_accepted = int(parts.get(_IMAGES_ACCEPTED, b"0"))
        except ValueError:
            errors[_IMAGES_ACCEPTED] = FrameError("uuv_modem state", "", parts[_IMAGES_ACCEPTED], "a number")
        if not self._is_v1:
            self._v1_parts = {name: data for name, data in parts.items() if name.startswith(_V1)}
            return errors | prefixed(_PAPER + _QUEUE, self.queue.restore(below(_PAPER + _QUEUE, parts)))
        errors |= prefixed(_V1 + _QUEUE, self.queue.restore(below(_V1 + _QUEUE, parts)))
        errors |= prefixed(_V1 + _RECEIVER, self._receiver.restore(below(_V1 + _RECEIVER, parts)))
        if self.authenticator is not None:
            skipped = self.authenticator.restore(below(_V1 + _AUTHENTICATION, parts))
            errors |= prefixed(_V1 + _AUTHENTICATION, skipped)
        if _V1 + _COMMANDS in parts:
            try:
                self._commands.restore(unpack_plain(dict, parts[_V1 + _COMMANDS], "uuv_modem state"))
            except BadInputError as error:
                errors[_V1 + _COMMANDS] = error
        return errors | self._take_images_of_paper_queue(below(_PAPER + _QUEUE, parts))

    def _take_images_of_paper_queue(self, parts: Parts) -> dict[str, BadInputError]:
        paper_queue = PaperSender(self._config.rate_info(self._config.rate))
        errors: dict[str, BadInputError] = dict(prefixed(_PAPER + _QUEUE, paper_queue.restore(parts)))
        for waiting in paper_queue.images:
            image = ImageToSend(waiting.image_id, waiting.contact_id, waiting.contact, waiting.stream)
            try:
                self._check_image(image)
                self.queue.add_image(image, 0.0)
            except BadInputError as error:
                errors[f"{_PAPER}{_QUEUE}image/{waiting.order}"] = error
        return errors

    def take_effects(self) -> UnitOfWork:
        """Return the counts and the new records for consumers, to commit together with the changed parts."""
        effects, self._effects = self._effects, UnitOfWork()
        self.changed = False
        return effects

    # Records of the vehicle's programs

    def check(self, record: EncodedImage | OutgoingMessage) -> None:
        """Check that the wire format can carry a record. Another thread may call this at any time.

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
        self.queue.on_feedback(unpack_mini(bits), now, source)
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
            FrameError: No counters are reserved for authentication, or all counters of the key are used.
        """
        before = self.queue.in_flight
        packet = self.queue.next_packet(now)
        self.changed |= packet is not before
        return packet

    def packet_sent(self, frames: tuple[bytes, ...], interval_s: float) -> None:
        """Record that frames of the packet in flight were sent; see `ImageSender.sent`."""
        for image in self.queue.sent(frames, interval_s):
            self._effects.count("images_sent")
            fields = kv(vehicle=self._platform_id, image_id=image.image_id, contact_id=image.contact_id)
            log.info("Image sent", extra=fields)
        self.changed = True

    def queue_state(self, now: float) -> QueueState:
        """Return the record of the transmit queue."""
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
