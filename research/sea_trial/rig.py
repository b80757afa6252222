"""The rig of `research.sea_trial`: the project's drivers on two emulated modems, so many metres of water between them.

Everything but the water is what runs on a vehicle and a vessel: packets planned by the sender of the `paper` format,
NMEA on both serial lines, the pairing receiver. The clock is simulated and jumps from event to event.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.link.frames.paper.receiver import PaperReceiver
from sonarpost.link.frames.paper.sender import Packet, plan_packets
from sonarpost.link.receiver import Event, ImageUpdate
from sonarpost.modem.micromodem import (
    RATES,
    FrameReceived,
    MicroModem,
    MicroModemConfig,
    ModemReady,
    PacketFailed,
    PacketSent,
)
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.parameters import ChannelParameters
from sonarpost.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.simulation.modem.settings import EmulatedModemConfig

VESSEL: Final = 1
VEHICLE: Final = 2

_SERIAL_BAUD: Final = 19_200.0
_DEPTH_M: Final = 6.4
_PAUSE_S: Final = 5.0
"""From the end of one packet to the next command, so that a fade does not take the same packets in every run."""
_PATIENCE_S: Final = 120.0
_STEP_S: Final = 0.001
_WAIT_FOR_HALF_S: Final = 600.0


@dataclass(frozen=True, slots=True)
class Sample:
    """A picture to send.

    Attributes:
        stream: The codec's stream.
        contact: Its record.
    """

    stream: bytes
    contact: ContactSummary


@dataclass(frozen=True, slots=True)
class Delivered:
    """What became of the pictures sent over one range at one rate.

    Attributes:
        packets: Packets sent.
        whole_packets: Of these, with every frame received.
        second_lost: Pictures of which the first packet came whole and a later one did not.
        frames: Frames sent.
        good_frames: Of these, received.
        pictures: Pictures sent.
        whole_pictures: Of these, put together to the last byte.
        partial_pictures: Of these, shown with something missing.
        contacts_only: Of these, known by their record alone.
    """

    packets: int
    whole_packets: int
    second_lost: int
    frames: int
    good_frames: int
    pictures: int
    whole_pictures: int
    partial_pictures: int
    contacts_only: int


class Rig:
    """Two drivers, two emulated modems and the water.

    Args:
        water: What the water does.
        range_m: Between the modems, both at the trial's depth.

    Raises:
        RuntimeError: The modems do not get ready; the emulator and the driver disagree.
    """

    def __init__(self, water: ChannelParameters, range_m: float) -> None:
        places = {
            number: PlacedModem(EmulatedModemConfig(number), LocalPosition(east_m, depth_m=_DEPTH_M))
            for number, east_m in ((VESSEL, 0.0), (VEHICLE, range_m))
        }
        self._world = ChannelSimulator(water, places, serial_baud=_SERIAL_BAUD)
        self._drivers = {number: MicroModem(MicroModemConfig(number)) for number in places}
        self._now = 0.0
        self._ready: set[int] = set()
        self._ended: list[PacketSent | PacketFailed] = []
        self._heard: list[FrameReceived] = []
        for driver in self._drivers.values():
            driver.start(0.0)
        self._run(_PATIENCE_S, until_ready=True)
        if len(self._ready) != len(self._drivers):
            raise RuntimeError(f"modems {sorted(self._ready)} are ready, expected {sorted(self._drivers)}")

    @property
    def now(self) -> float:
        """Simulated time, in seconds."""
        return self._now

    def send(self, packet: Packet, rate: int) -> list[FrameReceived]:
        """Send one packet from the vehicle; return what the vessel's driver hands over of it.

        Raises:
            RuntimeError: The vehicle's modem did not send it.
        """
        self._ended, self._heard = [], []
        self._drivers[VEHICLE].send_packet(VESSEL, rate, packet, now=self._now)
        self._run(self._now + _PATIENCE_S, until_sent=True)
        if not self._ended or isinstance(self._ended[0], PacketFailed):
            raise RuntimeError(f"a packet was not sent: {self._ended}")
        # Reception ends after transmission; what the modem has to say of it comes over the serial line after that.
        self._run(self._now + _PAUSE_S)
        return self._heard

    def _run(self, stop_s: float, *, until_ready: bool = False, until_sent: bool = False) -> None:
        while True:
            self._exchange()
            done = (until_ready and len(self._ready) == len(self._drivers)) or (until_sent and self._ended)
            if done or self._now >= stop_s:
                return
            times_s = [driver.next_wakeup() for driver in self._drivers.values()]
            next_s = min([self._world.next_deadline_s(), *(time_s for time_s in times_s if time_s is not None)])
            self._now = min(stop_s, max(next_s, self._now + _STEP_S))

    def _exchange(self) -> None:
        for number, driver in self._drivers.items():
            self._take(number, driver.poll(self._now))
            self._world.receive(number, driver.bytes_to_send(), self._now)
        self._world.advance(self._now)
        for number, driver in self._drivers.items():
            for output in self._world.take_outputs(number):
                self._take(number, driver.receive(output.data, self._now))
            # An answer to the modem goes at once: its time to take data is short.
            self._world.receive(number, driver.bytes_to_send(), self._now)

    def _take(self, number: int, events: Sequence[object]) -> None:
        for event in events:
            match event:
                case ModemReady():
                    self._ready.add(number)
                case PacketSent() | PacketFailed() if number == VEHICLE:
                    self._ended.append(event)
                case FrameReceived() if number == VESSEL:
                    self._heard.append(event)


def cross(water: ChannelParameters, range_m: float, rate: int, samples: Sequence[Sample]) -> Delivered:
    """Send pictures over a range, a packet at a time, and count what arrives.

    Args:
        water: What the water does.
        range_m: Distance, in metres.
        rate: Of the modem, 0..6.
        samples: The pictures, in the order of sending.
    """
    rig, receiver = Rig(water, range_m), PaperReceiver(_WAIT_FOR_HALF_S)
    shown: dict[str, bytes | None] = {}  # stream of a whole picture, nothing of a partial one, None of a bare record
    packets = whole = second_lost = frames = good = 0
    for number, sample in enumerate(samples):
        planned = plan_packets(
            format_image_id(number), sample.stream, sample.contact, RATES[rate].frames, RATES[rate].frame_bytes
        )
        came = []
        for packet in planned:
            heard = rig.send(packet, rate)
            for frame in heard:
                _show(shown, receiver.accept(frame.src, frame.data, rig.now))
            came.append(len(heard) == len(packet))
            frames += len(packet)
            good += len(heard)
        packets += len(planned)
        whole += sum(came)
        second_lost += came[0] and not all(came)
    _show(shown, receiver.poll(rig.now + _WAIT_FOR_HALF_S))
    streams = {format_image_id(number): sample.stream for number, sample in enumerate(samples)}
    return Delivered(
        packets=packets,
        whole_packets=whole,
        second_lost=second_lost,
        frames=frames,
        good_frames=good,
        pictures=len(samples),
        whole_pictures=sum(stream == streams[image_id] for image_id, stream in shown.items()),
        partial_pictures=sum(stream == b"" for stream in shown.values()),
        contacts_only=sum(stream is None for stream in shown.values()),
    )


def _show(shown: dict[str, bytes | None], events: Sequence[Event]) -> None:
    """Keep the best that is known of each picture."""
    for event in events:
        if isinstance(event, ImageUpdate) and event.stream:
            shown[event.image_id] = event.stream if event.complete else shown.get(event.image_id) or b""
        elif isinstance(event, ImageUpdate):
            shown.setdefault(event.image_id, None)
