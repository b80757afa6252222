"""How much of the time a vehicle that has data keeps the water busy: queue, medium access, driver, modem, serial line.

Everything runs as on a vehicle and a vessel, on a simulated clock: the vehicle's `TransmitQueue` and `Continuous`
medium, drivers on emulated modems with serial lines of a given speed, and a vessel that reports in the pauses.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from research.common.command import command_parser, run_command
from sonarpost.errors import ConfigError
from sonarpost.link.config import QueueConfig
from sonarpost.link.downlink.commands import CommandTracker
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.downlink.vessel_endpoint import DownlinkPacket, VesselEndpoint
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.mac import Continuous
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.link.receiver import FeedbackReceived
from sonarpost.link.sender import ImageToSend
from sonarpost.modem.micromodem import (
    RATES,
    FrameDecoded,
    FrameReceived,
    MicroModem,
    MicroModemConfig,
    ModemEvent,
    PacketFailed,
    PacketSent,
)
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.events import Transmission
from sonarpost.simulation.channel.parameters import ChannelParameters
from sonarpost.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.simulation.modem.settings import EmulatedModemConfig

_VESSEL: Final = 1
_VEHICLE: Final = 3
_STEP_S: Final = 0.001
_DOWNLINK_RATE: Final = 0
_QUIET_S: Final = 2.0
_TICK_S: Final = 0.25
_ALWAYS_WAITING: Final = 12
_STREAM_BYTES: Final = 400


@dataclass(frozen=True, slots=True)
class BusySpec:
    """What is measured.

    Attributes:
        rate: Of the vehicle, 0..6.
        serial_baud: Of both serial lines; 0 for lines without delay.
        tx_burst_s: See `Continuous`.
        rx_window_s: See `Continuous`.
        range_m: Between the modems.
        frame_loss: Share of frames lost.
        seconds: For how long, simulated.

    Raises:
        ConfigError: A value out of range.
    """

    rate: int = 5
    serial_baud: float = 0.0
    tx_burst_s: float = 150.0
    rx_window_s: float = 5.0
    range_m: float = 500.0
    frame_loss: float = 0.1
    seconds: float = 3600.0

    def __post_init__(self) -> None:
        if self.rate not in RATES:
            raise ConfigError("busy", "rate", self.rate, f"{min(RATES)}..{max(RATES)}")
        limits = (("serial_baud", 0, 4e6), ("range_m", 1, 2e4), ("frame_loss", 0, 0.9), ("seconds", 60, 864000))
        for name, low, high in limits:
            if not low <= getattr(self, name) <= high:
                raise ConfigError("busy", name, getattr(self, name), f"{low}..{high}")


@dataclass(frozen=True, slots=True)
class BusyResult:
    """What was measured.

    Attributes:
        busy: Share of the time in which the vehicle's packets were in the water.
        packets: Packets of the vehicle.
        frames_full: Share of the frames of its packets that it filled.
        reports: Reports of the vessel that the vehicle heard.
        reports_sent: Reports of the vessel.
    """

    busy: float
    packets: int
    frames_full: float
    reports: int
    reports_sent: int


class _Rig:
    def __init__(self, spec: BusySpec) -> None:
        places = {
            n: PlacedModem(EmulatedModemConfig(n), LocalPosition(e))
            for n, e in ((_VESSEL, 0.0), (_VEHICLE, spec.range_m))
        }
        water = ChannelParameters(frame_loss=spec.frame_loss)
        self.world = ChannelSimulator(water, places, spec.serial_baud or None)
        self.drivers = {n: MicroModem(MicroModemConfig(n)) for n in places}
        self.now = 0.0
        for driver in self.drivers.values():
            driver.start(0.0)
        self.sent: list[Transmission] = []

    @property
    def ready(self) -> bool:
        """Whether both modems are configured."""
        return all(driver.ready for driver in self.drivers.values())

    def wait(self, stop_s: float) -> None:
        """Go to when something happens next, to `stop_s` at the latest."""
        times_s = [self.world.next_deadline_s(), *(d.next_wakeup() or stop_s for d in self.drivers.values())]
        self.now = min(stop_s, max(min(times_s), self.now + _STEP_S))

    def step(self) -> list[tuple[int, ModemEvent]]:
        """Let happen what happens now; return the drivers' events."""
        events: list[tuple[int, ModemEvent]] = []
        for number, driver in self.drivers.items():
            events += [(number, event) for event in driver.poll(self.now)]
            self.world.receive(number, driver.bytes_to_send(), self.now)
        self.sent += [t for t in self.world.advance(self.now) if isinstance(t, Transmission)]
        for number, driver in self.drivers.items():
            for output in self.world.take_outputs(number):
                events += [(number, event) for event in driver.receive(output.data, self.now)]
            self.world.receive(number, driver.bytes_to_send(), self.now)
        return events


class _Vehicle:
    """Does what `uuv_modem` does."""

    def __init__(self, spec: BusySpec) -> None:
        self._rate = spec.rate
        self.queue = TransmitQueue(QueueConfig(rates=(spec.rate,), first_rate=spec.rate, expected_loss=spec.frame_loss))
        self._medium = Continuous(spec.tx_burst_s, spec.rx_window_s, holdoff_s=2.0)
        self._receiver = V1Receiver()
        self._asked = False
        self._rng = np.random.default_rng(1)
        self._number = 0
        self.frames = self.reports = 0

    def take(self, event: ModemEvent, now: float) -> None:
        match event:
            case PacketSent():
                self._medium.sent(event.started_s, now)
                self.queue.sent(event.frames, now - event.started_s)
                self._asked = False
            case PacketFailed():
                self._asked = False
            case FrameDecoded():
                self._medium.channel_busy(now)
            case FrameReceived():
                for found in self._receiver.accept(event.src, event.data, now):
                    if isinstance(found, FeedbackReceived):
                        self.queue.on_feedback(found.feedback, now, event.src)
                        self.reports += 1

    def work(self, driver: MicroModem, now: float) -> float:
        """Send where it may; return for how long it may not."""
        while len(self.queue.sender.waiting) < _ALWAYS_WAITING:
            self._number = self._number % 65535 + 1
            contact = ContactSummary(80, 80, time_utc_s=self._number)
            image_id, stream = image_of_number(self._number), self._rng.bytes(_STREAM_BYTES)
            self.queue.add_image(ImageToSend(image_id, str(self._number), contact, stream), now)
        if self._asked:
            return 0.0
        wait_s = self._medium.wait_s(RATES[self._rate].airtime_s, now) or 0.0
        if wait_s == 0.0 and driver.ready and (packet := self.queue.next_packet(now)):
            driver.send_packet(_VESSEL, self._rate, packet.frames, now=now)
            self._asked = True
            self.frames += len(packet.frames)
        return wait_s


class _Vessel:
    """Does what `op_modem` does: it reports when it has heard nothing for a while."""

    def __init__(self) -> None:
        self._link = VesselEndpoint(CommandTracker(60.0))
        self._heard_s = 0.0
        self._under_way: DownlinkPacket | None = None
        self.reports = 0

    def take(self, event: ModemEvent, now: float) -> None:
        match event:
            case FrameReceived():
                self._link.accept(event.src, event.data, now)
                self._heard_s = now
            case PacketSent() if self._under_way is not None:
                self._link.sent(self._under_way, now)
                self._under_way = None
            case PacketFailed() if self._under_way is not None:
                self._link.failed(self._under_way)
                self._under_way = None

    def work(self, driver: MicroModem, now: float) -> None:
        quiet = now - self._heard_s >= _QUIET_S and not driver.receiving and driver.ready
        if self._under_way is None and quiet and self._link.due_address(now) is not None:
            rate = RATES[_DOWNLINK_RATE]
            packet = self._link.next_packet(rate.frames, rate.frame_bytes, now)
            if packet is not None:
                driver.send_packet(packet.address, rate.number, packet.frames, now=now)
                self._under_way = packet
                self.reports += packet.has_feedback


def run_busy(spec: BusySpec) -> BusyResult:
    """Measure; the same specification gives the same result.

    The clock starts when both modems are configured. The vehicle always has pictures to send.
    """
    rig, vehicle, vessel = _Rig(spec), _Vehicle(spec), _Vessel()
    while not rig.ready:
        rig.step()
        rig.wait(rig.now + _TICK_S)
    begun, end = rig.now, rig.now + spec.seconds
    while rig.now < end:
        for number, event in rig.step():
            (vehicle if number == _VEHICLE else vessel).take(event, rig.now)
        wait_s = vehicle.work(rig.drivers[_VEHICLE], rig.now)
        vessel.work(rig.drivers[_VESSEL], rig.now)
        rig.step()  # what they asked for goes at once; it leads to no event but later ones
        rig.wait(min(end, rig.now + (min(wait_s, _TICK_S) or _TICK_S)))
    mine = [sent for sent in rig.sent if sent.transmitter == _VEHICLE]
    return BusyResult(
        busy=_within(mine, begun, end) / spec.seconds,
        packets=len(mine),
        frames_full=vehicle.frames / max(1, len(mine) * RATES[spec.rate].frames),
        reports=vehicle.reports,
        reports_sent=vessel.reports,
    )


def _within(sent: Sequence[Transmission], start_s: float, stop_s: float) -> float:
    return sum(max(0.0, min(t.ended_s, stop_s) - max(t.started_s, start_s)) for t in sent)


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    usual = BusySpec()
    parser = command_parser("utilisation", "share of the time that a vehicle with data keeps the water busy, simulated")
    parser.add_argument("--rate", type=int, default=usual.rate, help="0 to 6 (%(default)s)")
    parser.add_argument("--baud", type=float, default=usual.serial_baud, help="serial lines; 0 no delay (%(default)s)")
    parser.add_argument("--listen", type=float, default=usual.rx_window_s, metavar="S", help="each pause (%(default)s)")
    parser.add_argument("--every", type=float, default=usual.tx_burst_s, metavar="S", help="between (%(default)s)")
    parser.add_argument("--range", type=float, default=usual.range_m, metavar="M", help="in metres (%(default)s)")
    parser.add_argument("--loss", type=float, default=usual.frame_loss, help="share of frames lost (%(default)s)")
    parser.add_argument("--seconds", type=float, default=usual.seconds, help="for how long (%(default)s)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    spec = BusySpec(args.rate, args.baud, args.every, args.listen, args.range, args.loss, args.seconds)
    result = run_busy(spec)
    print(
        f"busy {result.busy:.4f}: {result.packets} packets, {result.frames_full:.3f} of their frames filled; "
        f"{result.reports} of {result.reports_sent} reports heard"
    )
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
