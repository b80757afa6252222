"""The vessel's end of the v1 link: what it hears of its vehicles, and what it has to say to them.

Pure: frames and `now` (UTC) in, what follows and packets out; the state can be saved and taken up by another process.
One packet carries all that is due for one vehicle, as far as there is room: orders, then the report of what is lacking.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from sonarpost.errors import FrameError
from sonarpost.link.config import ReceiverConfig
from sonarpost.link.downlink.commands import CommandTracker, PendingCommand
from sonarpost.link.downlink.messages import ConfirmationMessage, DataMessage, unpack
from sonarpost.link.events import FrameRefused, MessageReceived
from sonarpost.link.frames.v1.feedback import Feedback
from sonarpost.link.frames.v1.frame import FrameProtection, Segment, SegmentKind, pack_segments, segments_room
from sonarpost.link.receiver import LinkReceiver
from sonarpost.link.receiver_state import read_map, read_number

_STATE_FORMAT: Final = 1
_MOST_SILENT: Final = 6
"""Reports into silence come at twice the interval each time, so many times."""


@dataclass(frozen=True, slots=True)
class ReceivedContent:
    """What a frame has led to.

    Attributes:
        data: Other traffic of the vehicle, message by message.
        orders: Those whose state it has changed.
        refused: Why the frame, or a part of it, is of no use.
    """

    data: tuple[bytes, ...] = ()
    orders: tuple[PendingCommand, ...] = ()
    refused: tuple[FrameError, ...] = ()


@dataclass(frozen=True, slots=True)
class DownlinkPacket:
    """What is to be sent now.

    Attributes:
        address: To which modem.
        frames: The frames.
        tokens: Of the orders in it.
        reports: Whether a report is in it.
    """

    address: int
    frames: tuple[bytes, ...]
    tokens: tuple[int, ...]
    reports: bool


class VesselEndpoint:
    """Hears all vehicles and speaks to them.

    Args:
        book: The orders.
        config: When reports are due, and bounds.
        seal: Authenticates frames.
        feedback: Whether reports are sent.
    """

    def __init__(
        self,
        book: CommandTracker,
        config: ReceiverConfig | None = None,
        *,
        seal: FrameProtection | None = None,
        feedback: bool = True,
    ) -> None:
        self.book = book
        self.receiver = LinkReceiver(config, seal=seal)
        self._seal = seal
        self._feedback = feedback
        self._message_number = 0
        self._silent: dict[int, int] = {}
        self._reported_at: dict[int, float] = {}
        self._again: set[int] = set()

    def hear(self, source: int, frame: bytes, now: float) -> ReceivedContent:
        """Take a frame that was addressed to this vessel or to everybody. Never raises because of `frame`."""
        self._silent.pop(source, None)
        data: list[bytes] = []
        orders: list[PendingCommand] = []
        refused: list[FrameError] = []
        for event in self.receiver.accept(source, frame, now):
            if isinstance(event, FrameRefused):
                refused.append(event.reason)
            elif isinstance(event, MessageReceived):
                try:
                    content = unpack(event.data, f"message from modem {source}")
                except FrameError as error:
                    refused.append(error)
                    continue
                if isinstance(content, DataMessage):
                    data.append(content.data)
                elif isinstance(content, ConfirmationMessage):
                    orders += self.book.confirm(source, content.outcomes)
                # Orders are for vehicles: this one was another vessel's.
        return ReceivedContent(tuple(data), tuple(orders), tuple(refused))

    def wants_to_send(self, now: float) -> int | None:
        """Return the modem address that something is due for, None for none."""
        orders = self.book.due(now)
        if orders:
            return orders[0].address
        reports = [source for source in self.receiver.sources if self._report_is_due(source, now)]
        return min(reports, key=lambda source: self._reported_at.get(source, 0.0), default=None)

    def packet(self, frames: int, frame_bytes: int, now: float) -> DownlinkPacket | None:
        """Return the packet to send now, None when nothing is due.

        Follow it with `sent` or `failed`.

        Args:
            frames: Most frames in it.
            frame_bytes: Length of each.
            now: Seconds UTC.

        Raises:
            FrameError: Frames cannot be sealed any more, or an order does not fit a frame. All of it is still due.
        """
        address = self.wants_to_send(now)
        if address is None:
            return None
        filling = _FramePacker(frames, segments_room(frame_bytes, self._seal))
        number = self._message_number
        tokens: list[int] = []
        for order in self.book.due(now):
            if order.address == address:
                # A number of its own each time: to the link, the same message again would be a repetition, and the
                # vehicle would not hear that its confirmation was lost.
                segment = Segment(SegmentKind.MESSAGE, bytes([number]) + order.message)
                if filling.add(segment):
                    tokens.append(order.token)
                    number = (number + 1) % 256
        report = self._report(address, now, filling)
        if not filling.frames:
            room = segments_room(frame_bytes, self._seal)
            raise FrameError("downlink", "frame", f"{room} bytes of room", "room for an order: a higher rate")
        try:
            packed = tuple(pack_segments(each, frame_bytes, self._seal) for each in filling.frames)
        except FrameError:
            self._again |= {address} if report else set()
            raise
        self._message_number = number
        if report:
            self._silent[address] = self._silent.get(address, -1) + 1
            self._reported_at[address] = now
            self._again.discard(address)
        return DownlinkPacket(address, packed, tuple(tokens), report)

    def _report(self, address: int, now: float, filling: _FramePacker) -> bool:
        """Add the report for a vehicle, where there is one and room for it."""
        if not self._feedback or not (self._report_is_due(address, now) or self.receiver.mini_report(address)):
            return False
        longest = Segment(SegmentKind.FEEDBACK, bytes(Feedback(0, 0, (0,) * 16).pack()))
        if not filling.fits(longest):
            return False
        found = self.receiver.report(address, now)
        return found is not None and filling.add(Segment(SegmentKind.FEEDBACK, found.pack()))

    def _report_is_due(self, source: int, now: float) -> bool:
        if not self._feedback:
            return False
        if source in self._again:
            return True
        silent = self._silent.get(source, -1)
        if silent >= 0:
            wait_s = self.receiver.config.feedback_interval_s * 2**silent
            last = self._reported_at.get(source, 0.0)
            if silent >= _MOST_SILENT or now - last < wait_s:
                return False
        return self.receiver.report_is_due(source, now)

    def sent(self, packet: DownlinkPacket, now: float) -> tuple[PendingCommand, ...]:
        """Note that a packet has gone into the water; return the orders that were in it."""
        return self.book.sent(packet.tokens, now)

    def failed(self, packet: DownlinkPacket) -> None:
        """Note that a packet has not gone: what was in it is still due."""
        if packet.reports:
            self._again.add(packet.address)

    def snapshot(self) -> dict[str, object]:
        """Return the state as maps, lists, numbers, strings and bytes (msgpack can hold it).

        When reports were sent is not in it: after a restart they may come a little early.
        """
        return {
            "format": _STATE_FORMAT,
            "receiver": self.receiver.snapshot(),
            "orders": self.book.snapshot(),
            "message_number": self._message_number,
        }

    def restore(self, state: Mapping[str, object]) -> None:
        """Take up a state that `snapshot` returned.

        Raises:
            FrameError: It did not return this.
        """
        if state.get("format") != _STATE_FORMAT:
            raise FrameError("vessel's link", "format", state.get("format"), str(_STATE_FORMAT))
        number = read_number(state, "message_number", 0, 255)
        self.receiver.restore(read_map(state, "receiver"))
        self.book.restore(read_map(state, "orders"))
        self._message_number = number


class _FramePacker:
    """Segments put into as few frames as they fit, in their order."""

    def __init__(self, most_frames: int, room_bytes: int) -> None:
        self.frames: list[list[Segment]] = []
        self._left: list[int] = []
        self._most = most_frames
        self._room_bytes = room_bytes

    def fits(self, segment: Segment) -> bool:
        """Whether there is room for a segment."""
        new = len(self.frames) < self._most and segment.size <= self._room_bytes
        return new or any(segment.size <= left for left in self._left)

    def add(self, segment: Segment) -> bool:
        """Put a segment where there is room; tell whether there was."""
        if not self.fits(segment):
            return False
        place = next((n for n, left in enumerate(self._left) if segment.size <= left), None)
        if place is None:
            place = len(self.frames)
            self.frames.append([])
            self._left.append(self._room_bytes)
        self.frames[place].append(segment)
        self._left[place] -= segment.size
        return True
