"""The vessel's end of the link: receives frames of its vehicles, and sends them commands and feedback.

One packet carries everything that is due for one vehicle, as far as it fits: commands first, then feedback. `now` is
UTC in seconds, because another process can restore the state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sonarpost.errors import FrameError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.merging import FrameMerger
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.downlink.commands import CommandState, CommandTracker, PendingCommand, retry_factor
from sonarpost.link.downlink.messages import ConfirmationMessage, DataMessage, DecisionMessage, unpack
from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments, segments_room
from sonarpost.link.frames.v1.payload_objects import Feedback
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.receiver import (
    CombinedReceiver,
    Event,
    FeedbackReceived,
    FrameRejected,
    ImageUpdate,
    MessageReceived,
    WireFormat,
)
from sonarpost.link.state import Byte, Errors, PartReader, Parts, below, pack_part, prefixed

_MAX_UNANSWERED: Final = 24
"""Maximum number of repetitions of feedback that no frame of the vehicle follows."""
_MAX_WAIT_INTERVALS: Final = 10
"""The wait between repetitions grows from one feedback interval up to this many."""


@dataclass(frozen=True, slots=True)
class ReceivedContent:
    """What followed from a frame.

    Attributes:
        images: Updates of images.
        messages: Messages of the vehicle's programs.
        commands: Commands whose state changed.
        rejected: Why the frame, or a part of it, was rejected.
        statuses: Statuses of the vehicle.
    """

    images: tuple[ImageUpdate, ...] = ()
    messages: tuple[bytes, ...] = ()
    commands: tuple[PendingCommand, ...] = ()
    rejected: tuple[FrameError, ...] = ()
    statuses: tuple[StatusMessage, ...] = ()


@dataclass(frozen=True, slots=True)
class DownlinkPacket:
    """A packet to send.

    Attributes:
        address: Modem address of the vehicle.
        frames: The frames.
        tokens: Tokens of the commands in it.
        has_feedback: Whether feedback is in it.
    """

    address: int
    frames: tuple[bytes, ...]
    tokens: tuple[int, ...]
    has_feedback: bool


@dataclass(frozen=True, slots=True)
class EndpointState:
    """Saved state of the endpoint itself.

    Attributes:
        message_number: Number of the next message.
        overheard: Modem addresses of the vehicles whose last frame was addressed to another station.
    """

    message_number: Byte = 0
    overheard: tuple[Byte, ...] = ()


class VesselEndpoint:
    """Receives from all vehicles and sends to them.

    Args:
        commands: The commands.
        config: Configuration of the receiver of `v1`.
        protection: Authenticates frames. With it the `paper` format is rejected: it has no authentication.
        merger: Merges the frames that other vessels received; None without other vessels.
        feedback: Whether feedback is sent.
        wire_formats: Formats to receive.
        pairing_timeout_s: See `PaperReceiver`.
    """

    def __init__(
        self,
        commands: CommandTracker,
        config: ReceiverConfig | None = None,
        *,
        protection: FrameAuthenticator | None = None,
        merger: FrameMerger | None = None,
        feedback: bool = True,
        wire_formats: Sequence[WireFormat] = ("v1",),
        pairing_timeout_s: float = 60.0,
    ) -> None:
        self.commands = commands
        self.v1 = V1Receiver(config, protection=protection, merger=merger)
        memory_s = max(self.v1.config.contact_memory_s, pairing_timeout_s)
        self.paper = PaperReceiver(pairing_timeout_s, memory_s=memory_s)
        self._receiver = CombinedReceiver(
            self.v1 if "v1" in wire_formats else None,
            self.paper if "paper" in wire_formats and protection is None else None,
        )
        self._protection = protection
        self._feedback = feedback
        self._message_number = 0
        self._unanswered: dict[int, int] = {}
        self._served: dict[int, int] = {}  # rises with each packet, by address
        self._sent_commands = False
        self._feedback_s: dict[int, float] = {}
        self._feedback_failed: set[int] = set()
        self._overheard: set[int] = set()

    def accept(
        self, source: int, frame: bytes, now: float, *, overheard: bool = False, vessel: str = ""
    ) -> ReceivedContent:
        """Process a frame. Never raises because of `frame`.

        Args:
            source: Modem address of the sender.
            frame: The frame as the modem delivered it.
            now: UTC in seconds.
            overheard: The frame was addressed to another station. Only its images are used, and its sender gets no
                feedback until it sends a frame to this station.
            vessel: Name of the other vessel that received the frame; empty for this one.
        """
        if vessel:
            events = self.v1.accept_from(vessel, source, frame, now)
        else:
            events = self._receiver.accept(source, frame, now)
        if overheard:
            content = self._content([event for event in events if not isinstance(event, MessageReceived)])
            self._overheard |= set() if content.rejected else {source}
            return content
        content = self._content(events)
        self._overheard.discard(source)
        self._unanswered.pop(source, None)
        return content

    def poll(self, now: float) -> tuple[ImageUpdate, ...]:
        """Return the images that are due without a frame."""
        return self._content(self._receiver.poll(now)).images

    def next_deadline(self) -> float | None:
        """Return when `poll` has the next image, None if no image waits."""
        return self._receiver.next_deadline()

    @property
    def feedback_open(self) -> int:
        """Number of vehicles to which feedback is due, or will be repeated if they send nothing.

        The feedback that only announces the vessel, long after the last one, does not count.
        """
        return sum(
            self._feedback
            and source not in self._overheard
            and (
                source in self._feedback_failed
                or (self._unanswered.get(source, -1) < _MAX_UNANSWERED and self.v1.feedback_is_useful(source))
            )
            for source in self.v1.sources
        )

    @property
    def incomplete_images(self) -> int:
        """Number of known images of which not everything has arrived."""
        return self.v1.incomplete_images + self.paper.incomplete_images

    def _content(self, events: Sequence[Event]) -> ReceivedContent:
        images: list[ImageUpdate] = []
        messages: list[bytes] = []
        commands: list[PendingCommand] = []
        rejected: list[FrameError] = []
        statuses: list[StatusMessage] = []
        for event in events:
            match event:
                case ImageUpdate():
                    images.append(event)
                case FrameRejected():
                    rejected.append(event.reason)
                case FeedbackReceived():
                    pass  # another vessel's, to its vehicle
                case MessageReceived():
                    try:
                        content = unpack(event.data, f"message from modem {event.source}")
                    except FrameError as error:
                        rejected.append(error)
                        continue
                    if isinstance(content, DataMessage):
                        messages.append(content.data)
                    elif isinstance(content, StatusMessage):
                        statuses.append(content)
                    elif isinstance(content, ConfirmationMessage):
                        confirmed = self.commands.confirm(event.source, content.outcomes)
                        self._stop_decided_images(confirmed)
                        commands += confirmed
                    # Other contents are commands of another vessel.
        return ReceivedContent(tuple(images), tuple(messages), tuple(commands), tuple(rejected), tuple(statuses))

    def _stop_decided_images(self, confirmed: Sequence[PendingCommand]) -> None:
        for command in confirmed:
            if command.kind == "decision" and command.state is CommandState.CONFIRMED:
                decision = unpack(command.message)
                if isinstance(decision, DecisionMessage) and decision.is_final:
                    self.v1.stop_image(command.address, decision.number)

    def due_address(self, now: float) -> int | None:
        """Return the modem address of the vehicle that something is due for, None for none.

        Vehicles take turns, and commands and feedback too: commands do not wait for the feedback of many addresses.
        """
        with_commands = [command.address for command in self.commands.due(now)]
        with_feedback = [source for source in self.v1.sources if self._feedback_is_due(source, now)]
        with_feedback.sort(key=lambda source: self._feedback_s.get(source, 0.0))
        addresses = with_feedback if self._sent_commands and with_feedback else with_commands or with_feedback
        return min(addresses, key=lambda address: self._served.get(address, 0), default=None)

    def next_packet(self, max_frames: int, frame_bytes: int, now: float) -> DownlinkPacket | None:
        """Return the packet to send now, None if nothing is due; call `sent` or `failed` next.

        Args:
            max_frames: Maximum number of frames in it.
            frame_bytes: Length of each frame.
            now: UTC in seconds.

        Raises:
            FrameError: Frames cannot be protected any more, or a command does not fit a frame. All content stays due.
        """
        address = self.due_address(now)
        if address is None:
            return None
        packer = _FramePacker(max_frames, segments_room(frame_bytes, self._protection))
        number = self._message_number
        tokens: list[int] = []
        for command in self.commands.due(now):
            if command.address == address:
                # A new number for every copy: with the same number, the vehicle's link would drop it as a repetition,
                # and the vehicle could not repeat a lost confirmation.
                segment = Segment(SegmentKind.MESSAGE, bytes([number]) + command.message)
                if packer.add(segment):
                    tokens.append(command.token)
                    number = (number + 1) % 256
        has_feedback = self._add_feedback(address, now, packer)
        if not packer.frames:
            room = segments_room(frame_bytes, self._protection)
            raise FrameError("downlink", "frame", f"{room} bytes of room", "room for a command: a higher rate")
        try:
            packed = tuple(pack_segments(each, frame_bytes, self._protection) for each in packer.frames)
        except FrameError:
            self._feedback_failed |= {address} if has_feedback else set()
            raise
        self._message_number = number
        self._sent_commands = bool(tokens)
        self._served[address] = max(self._served.values(), default=0) + 1
        if has_feedback:
            self._unanswered[address] = self._unanswered.get(address, -1) + 1
            self._feedback_s[address] = now
            self._feedback_failed.discard(address)
        return DownlinkPacket(address, packed, tuple(tokens), has_feedback)

    def _add_feedback(self, address: int, now: float, packer: _FramePacker) -> bool:
        """Add the feedback for a vehicle, if there is some and it fits."""
        if not self._feedback or not (self._feedback_is_due(address, now) or self.v1.is_incomplete(address)):
            return False
        longest = Segment(SegmentKind.FEEDBACK, Feedback(0, 0, (0,) * 16).pack())
        if not packer.fits(longest):
            return False
        feedback = self.v1.feedback(address, now)
        return feedback is not None and packer.add(Segment(SegmentKind.FEEDBACK, feedback.pack()))

    def _feedback_is_due(self, source: int, now: float) -> bool:
        if not self._feedback or source in self._overheard:
            return False
        if source in self._feedback_failed:
            return True
        unanswered = self._unanswered.get(source, -1)
        if unanswered >= 0:
            wait_s = self.v1.config.feedback_interval_s * retry_factor(unanswered, math.log2(_MAX_WAIT_INTERVALS))
            if unanswered >= _MAX_UNANSWERED or now - self._feedback_s.get(source, 0.0) < wait_s:
                return False
        return self.v1.feedback_is_due(source, now)

    def sent(self, packet: DownlinkPacket, now: float) -> tuple[PendingCommand, ...]:
        """Record that a packet has been sent; return the commands that changed."""
        return self.commands.sent(packet.tokens, now)

    def failed(self, packet: DownlinkPacket) -> None:
        """Record that a packet has not been sent: its content is due again."""
        if packet.has_feedback:
            self._feedback_failed.add(packet.address)

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`.

        The times of feedback are not saved: after a restart feedback can be a little early.
        """
        return {
            "endpoint": pack_part(EndpointState(self._message_number, tuple(sorted(self._overheard)))),
            **prefixed("v1/", self.v1.parts()),
            **prefixed("paper/", self.paper.parts()),
            **prefixed("commands/", self.commands.parts()),
        }

    def restore(self, parts: Parts) -> Errors:
        """Replace the state by saved parts; return why parts were skipped."""
        reader = PartReader(parts, "vessel endpoint state")
        state = reader.read("endpoint", EndpointState) or EndpointState()
        self._message_number = state.message_number
        self._overheard = set(state.overheard)
        errors = dict(reader.errors)
        for prefix, restore in (
            ("v1/", self.v1.restore),
            ("paper/", self.paper.restore),
            ("commands/", self.commands.restore),
        ):
            errors |= {prefix + name: error for name, error in restore(below(prefix, parts)).items()}
        return errors


class _FramePacker:
    """Puts segments into as few frames as possible, in their order."""

    def __init__(self, max_frames: int, room_bytes: int) -> None:
        self.frames: list[list[Segment]] = []
        self._max_frames = max_frames
        self._room_bytes = room_bytes

    def _place(self, segment: Segment) -> int | None:
        """Return the index of the first frame with room for a segment, possibly a new one."""
        used = [sum(each.size for each in frame) for frame in self.frames]
        used += [0] if len(used) < self._max_frames else []
        return next((n for n, size in enumerate(used) if size + segment.size <= self._room_bytes), None)

    def fits(self, segment: Segment) -> bool:
        """Whether there is room for a segment."""
        return self._place(segment) is not None

    def add(self, segment: Segment) -> bool:
        """Add a segment if there is room; return whether there was."""
        place = self._place(segment)
        if place is None:
            return False
        if place == len(self.frames):
            self.frames.append([])
        self.frames[place].append(segment)
        return True
