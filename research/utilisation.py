"""`python -m research.utilisation`: share of the time in which a vehicle with data transmits, simulated.

Transmit queue, medium access, driver, modem and serial line are those of a vehicle, on a simulated clock: a
`TransmitQueue` with the `Continuous` MAC, drivers on emulated modems with serial lines of a given speed, and a vessel
that sends feedback in the receive windows.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from research.common.command import command_parser, run_command
from research.common.modem_pair import VESSEL, ModemPair
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.channel.events import TransmittedPacket
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
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
from sonarpost.modem.interface import FrameDecoded, FrameReceived, ModemEvent, PacketFailed, PacketSent
from sonarpost.modem.micromodem import RATES, MicroModem

_VEHICLE: Final = 3
_DOWNLINK_RATE: Final = 0
_FEEDBACK_HOLDOFF_S: Final = 2.0
_MAX_STEP_S: Final = 0.25
_MIN_WAITING: Final = 12
_STREAM_BYTES: Final = 400


@dataclass(frozen=True, slots=True)
class UtilisationSpec:
    """Parameters of a measurement.

    Attributes:
        rate: Rate of the vehicle's modem, 0..6.
        serial_baud: Speed of both serial lines; 0 for no delay.
        tx_burst_s: See `Continuous`.
        rx_window_s: See `Continuous`.
        range_m: Distance of the modems.
        frame_loss: Share of frames lost.
        seconds: Simulated duration.

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
            raise ConfigError("utilisation", "rate", self.rate, f"{min(RATES)}..{max(RATES)}")
        limits = (("serial_baud", 0, 4e6), ("range_m", 1, 2e4), ("frame_loss", 0, 0.9), ("seconds", 60, 864000))
        for name, low, high in limits:
            if not low <= getattr(self, name) <= high:
                raise ConfigError("utilisation", name, getattr(self, name), f"{low}..{high}")


@dataclass(frozen=True, slots=True)
class UtilisationResult:
    """Result of a measurement.

    Attributes:
        busy: Share of the time in which the vehicle transmitted.
        packets: Packets of the vehicle.
        frames_full: Share of the frames of its packets that contained data.
        feedback_received: Feedback messages received by the vehicle.
        feedback_sent: Feedback messages sent by the vessel.
    """

    busy: float
    packets: int
    frames_full: float
    feedback_received: int
    feedback_sent: int


class _Vehicle:
    """The vehicle: transmit queue and medium access like those of `uuv_modem`."""

    def __init__(self, spec: UtilisationSpec) -> None:
        self._rate = spec.rate
        self.queue = TransmitQueue(
            QueueConfig(rates=(RATES[spec.rate],), first_rate=spec.rate, expected_loss=spec.frame_loss)
        )
        self._mac = Continuous(spec.tx_burst_s, spec.rx_window_s, holdoff_s=2.0)
        self._receiver = V1Receiver()
        self._is_sending = False
        self._rng = np.random.default_rng(1)
        self._number = 0
        self.frames = self.feedback_received = 0

    def handle(self, event: ModemEvent, now: float) -> None:
        match event:
            case PacketSent():
                self._mac.sent(event.started_s, now)
                self.queue.sent(event.frames, now - event.started_s)
                self._is_sending = False
            case PacketFailed():
                self._is_sending = False
            case FrameDecoded():
                self._mac.channel_busy(now)
            case FrameReceived():
                for found in self._receiver.accept(event.src, event.data, now):
                    if isinstance(found, FeedbackReceived):
                        self.queue.on_feedback(found.feedback, now, event.src)
                        self.feedback_received += 1

    def send(self, driver: MicroModem, now: float) -> float:
        """Send a packet if the MAC allows it; return the remaining wait."""
        while len(self.queue.sender.waiting) < _MIN_WAITING:
            self._number = self._number % 65535 + 1
            contact = ContactSummary(80, 80, time_utc_s=self._number)
            image_id, stream = image_of_number(self._number), self._rng.bytes(_STREAM_BYTES)
            self.queue.add_image(ImageToSend(image_id, str(self._number), contact, stream), now)
        if self._is_sending:
            return 0.0
        wait_s = self._mac.wait_s(RATES[self._rate].airtime_s, now) or 0.0
        if wait_s == 0.0 and driver.ready and (packet := self.queue.next_packet(now)):
            driver.send_packet(VESSEL, self._rate, packet.frames, now=now)
            self._is_sending = True
            self.frames += len(packet.frames)
        return wait_s


class _Vessel:
    """The vessel: it sends feedback after a pause without reception, like `op_modem`."""

    def __init__(self) -> None:
        self._link = VesselEndpoint(CommandTracker(60.0))
        self._last_received_s = 0.0
        self._in_flight: DownlinkPacket | None = None
        self.feedback_sent = 0

    def handle(self, event: ModemEvent, now: float) -> None:
        match event:
            case FrameReceived():
                self._link.accept(event.src, event.data, now)
                self._last_received_s = now
            case PacketSent() if self._in_flight is not None:
                self._link.sent(self._in_flight, now)
                self._in_flight = None
            case PacketFailed() if self._in_flight is not None:
                self._link.failed(self._in_flight)
                self._in_flight = None

    def send(self, driver: MicroModem, now: float) -> None:
        is_quiet = now - self._last_received_s >= _FEEDBACK_HOLDOFF_S and not driver.receiving and driver.ready
        if self._in_flight is None and is_quiet and self._link.due_address(now) is not None:
            rate = RATES[_DOWNLINK_RATE]
            packet = self._link.next_packet(rate.frames, rate.frame_bytes, now)
            if packet is not None:
                driver.send_packet(packet.address, rate.number, packet.frames, now=now)
                self._in_flight = packet
                self.feedback_sent += packet.has_feedback


def measure_utilisation(spec: UtilisationSpec) -> UtilisationResult:
    """Run a measurement; the same specification gives the same result.

    It starts when both modems are configured. The vehicle always has images to send.
    """
    channel = ChannelParameters(frame_loss=spec.frame_loss)
    modems = ModemPair(channel, _VEHICLE, spec.range_m, serial_baud=spec.serial_baud or None)
    vehicle, vessel = _Vehicle(spec), _Vessel()
    while not modems.ready:
        modems.step()
        modems.advance(modems.now + _MAX_STEP_S)
    start_s, end_s = modems.now, modems.now + spec.seconds
    while modems.now < end_s:
        for number, event in modems.step():
            (vehicle if number == _VEHICLE else vessel).handle(event, modems.now)
        wait_s = vehicle.send(modems.drivers[_VEHICLE], modems.now)
        vessel.send(modems.drivers[VESSEL], modems.now)
        modems.step()  # commands are sent at once; their events follow later
        modems.advance(min(end_s, modems.now + (min(wait_s, _MAX_STEP_S) or _MAX_STEP_S)))
    transmissions = [t for t in modems.transmissions if t.transmitter == _VEHICLE]
    return UtilisationResult(
        busy=_airtime_s(transmissions, start_s, end_s) / spec.seconds,
        packets=len(transmissions),
        frames_full=vehicle.frames / max(1, len(transmissions) * RATES[spec.rate].frames),
        feedback_received=vehicle.feedback_received,
        feedback_sent=vessel.feedback_sent,
    )


def _airtime_s(transmissions: Sequence[TransmittedPacket], start_s: float, stop_s: float) -> float:
    return sum(max(0.0, min(t.ended_s, stop_s) - max(t.started_s, start_s)) for t in transmissions)


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    default = UtilisationSpec()
    parser = command_parser("utilisation", "share of the time in which a vehicle with data transmits, simulated")
    parser.add_argument("--rate", type=int, default=default.rate, help="0 to 6 (%(default)s)")
    parser.add_argument(
        "--baud", type=float, default=default.serial_baud, help="serial speed; 0: no delay (%(default)s)"
    )
    parser.add_argument("--listen", type=float, default=default.rx_window_s, metavar="S", help="window (%(default)s)")
    parser.add_argument(
        "--every", type=float, default=default.tx_burst_s, metavar="S", help="between windows (%(default)s)"
    )
    parser.add_argument("--range", type=float, default=default.range_m, metavar="M", help="distance (%(default)s)")
    parser.add_argument("--loss", type=float, default=default.frame_loss, help="share of frames lost (%(default)s)")
    parser.add_argument("--seconds", type=float, default=default.seconds, help="simulated duration (%(default)s)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    spec = UtilisationSpec(args.rate, args.baud, args.every, args.listen, args.range, args.loss, args.seconds)
    result = measure_utilisation(spec)
    print(
        f"busy {result.busy:.4f}: {result.packets} packets, {result.frames_full:.3f} of their frames filled; "
        f"{result.feedback_received} of {result.feedback_sent} feedback messages received"
    )
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
