"""Two modem drivers with emulated modems at a distance, for `research.sea_trial`.

Except for the channel, this is the software of a vehicle and a vessel: packets planned by the sender of the paper's
format, NMEA on both serial lines, the receiver of the paper's format. The clock is simulated, from event to event.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from research.common.modem_pair import VESSEL, ModemPair
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import Packet, plan_packets
from sonarpost.link.receiver import Event, ImageUpdate
from sonarpost.modem.interface import FrameReceived, PacketFailed, PacketSent
from sonarpost.modem.micromodem import RATES

VEHICLE: Final = 2

_SERIAL_BAUD: Final = 19_200.0
_DEPTH_M: Final = 6.4
_PAUSE_S: Final = 5.0
"""Time between packets, so that a fade does not affect the same packets in every run."""
_TIMEOUT_S: Final = 120.0
_PAIRING_TIMEOUT_S: Final = 600.0


@dataclass(frozen=True, slots=True)
class CodedSnippet:
    """An image to send.

    Attributes:
        stream: Stream of the codec.
        contact: Contact record.
    """

    stream: bytes
    contact: ContactSummary


@dataclass(frozen=True, slots=True)
class DeliveryCounts:
    """Counts for one range and rate. The names are those of the JSON output.

    Attributes:
        packets: Packets sent.
        whole_packets: Packets received with all frames.
        second_lost: Images with a complete first packet and an incomplete later one.
        frames: Frames sent.
        good_frames: Frames received.
        images: Images sent.
        whole_images: Images received completely.
        partial_images: Images received in part.
        contacts_only: Images of which only the contact record was received.
    """

    packets: int
    whole_packets: int
    second_lost: int
    frames: int
    good_frames: int
    images: int
    whole_images: int
    partial_images: int
    contacts_only: int


class Rig:
    """A vehicle that sends packets to a vessel.

    Args:
        channel: Parameters of the channel.
        range_m: Distance between the modems, both at the depth of the trial.

    Raises:
        RuntimeError: The modems do not become ready: emulator and driver disagree.
    """

    def __init__(self, channel: ChannelParameters, range_m: float) -> None:
        self._modems = ModemPair(channel, VEHICLE, range_m, depth_m=_DEPTH_M, serial_baud=_SERIAL_BAUD)
        self._finished: list[PacketSent | PacketFailed] = []
        self._received: list[FrameReceived] = []
        self._run(_TIMEOUT_S, lambda: self._modems.ready)
        if not self._modems.ready:
            raise RuntimeError("the modems are not ready")

    @property
    def now(self) -> float:
        """Simulated time, in seconds."""
        return self._modems.now

    def send(self, packet: Packet, rate: int) -> list[FrameReceived]:
        """Send one packet from the vehicle; return the frames received by the vessel's driver.

        Raises:
            RuntimeError: The vehicle's modem did not send it.
        """
        self._finished, self._received = [], []
        self._modems.drivers[VEHICLE].send_packet(VESSEL, rate, packet, now=self.now)
        self._run(self.now + _TIMEOUT_S, lambda: bool(self._finished))
        if not self._finished or isinstance(self._finished[0], PacketFailed):
            raise RuntimeError(f"a packet was not sent: {self._finished}")
        # Reception ends after transmission; the sentences of the modem arrive over the serial line after that.
        self._run(self.now + _PAUSE_S, lambda: False)
        return self._received

    def _run(self, stop_s: float, is_done: Callable[[], bool]) -> None:
        while True:
            for number, event in self._modems.step():
                match event:
                    case PacketSent() | PacketFailed() if number == VEHICLE:
                        self._finished.append(event)
                    case FrameReceived() if number == VESSEL:
                        self._received.append(event)
            if is_done() or self.now >= stop_s:
                return
            self._modems.advance(stop_s)


def send_images(
    channel: ChannelParameters, range_m: float, rate: int, snippets: Sequence[CodedSnippet]
) -> DeliveryCounts:
    """Send images over a range, one packet at a time, and count received packets and images.

    Args:
        channel: Parameters of the channel.
        range_m: Distance of the modems.
        rate: Rate of the modem, 0..6.
        snippets: The images, in the order of sending.
    """
    rig, receiver = Rig(channel, range_m), PaperReceiver(_PAIRING_TIMEOUT_S)
    # By image: stream of a complete image, empty for a partial one, None for a record without image.
    received_streams: dict[str, bytes | None] = {}
    packets = complete_packets = second_lost = frames = received_frames = 0
    for number, snippet in enumerate(snippets):
        planned = plan_packets(
            format_image_id(number), snippet.stream, snippet.contact, RATES[rate].frames, RATES[rate].frame_bytes
        )
        complete = []
        for packet in planned:
            received = rig.send(packet, rate)
            for frame in received:
                _update(received_streams, receiver.accept(frame.src, frame.data, rig.now))
            complete.append(len(received) == len(packet))
            frames += len(packet)
            received_frames += len(received)
        packets += len(planned)
        complete_packets += sum(complete)
        second_lost += complete[0] and not all(complete)
    _update(received_streams, receiver.poll(rig.now + _PAIRING_TIMEOUT_S))
    streams = {format_image_id(number): snippet.stream for number, snippet in enumerate(snippets)}
    return DeliveryCounts(
        packets=packets,
        whole_packets=complete_packets,
        second_lost=second_lost,
        frames=frames,
        good_frames=received_frames,
        images=len(snippets),
        whole_images=sum(stream == streams[image_id] for image_id, stream in received_streams.items()),
        partial_images=sum(stream == b"" for stream in received_streams.values()),
        contacts_only=sum(stream is None for stream in received_streams.values()),
    )


def _update(received_streams: dict[str, bytes | None], events: Sequence[Event]) -> None:
    """Store the best result for each image."""
    for event in events:
        if isinstance(event, ImageUpdate) and event.stream:
            best = event.stream if event.complete else received_streams.get(event.image_id) or b""
            received_streams[event.image_id] = best
        elif isinstance(event, ImageUpdate):
            received_streams.setdefault(event.image_id, None)
