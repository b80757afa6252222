"""`python -m research.request_times`: time from a request to its answer, on simulated time.

The vehicle has the endpoint, the queue and the medium access of `uuv_modem`; the vessel those of `op_modem`. Modems are
half-duplex, and each frame is lost with the same probability in both directions. Processes are not simulated.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from research.common.command import command_parser, run_command
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.downlink.vessel_endpoint import DownlinkPacket
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.sender import ImageToSend
from sonarpost.messages import Command
from sonarpost.modem.interface import RateInfo
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.transmission import TransmitGate
from sonarpost.services.op_modem.vessel_endpoint import VesselLink
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.vehicle_endpoint import VehicleEndpoint

_VEHICLE: Final = 3
_VESSEL: Final = 1
_STEP_S: Final = 0.1
_TRAVEL_S: Final = 0.7
_CODING_S: Final = 2.0
_FIRST_REQUEST_S: Final = 600.0
_LAST_S: Final = 3600.0
_STREAM_BYTES: Final = 131
_LONGER: Final = 2
LOST_FRAMES: Final = 0.3
_FIRST_CONTACTS: Final = 4


@dataclass(frozen=True, slots=True)
class RequestSpec:
    """Parameters of a run.

    Attributes:
        kind: "expand", which is answered with an image of its own, or "refine".
        loss: Share of frames lost in each direction.
        contact_every_s: Mean time between contacts; 0 for one contact at the start and none later.
        seed: Seed of all random draws.
        vehicle: Options of `[uuv_modem]`.
        vessel: Options of `[op_modem]`.
    """

    kind: str = "expand"
    loss: float = LOST_FRAMES
    contact_every_s: float = 0.0
    seed: int = 1
    vehicle: Mapping[str, object] = field(default_factory=dict)
    vessel: Mapping[str, object] = field(default_factory=dict)


@dataclass(slots=True)
class _Packet:
    """A packet on the channel: its frames, and the times of its transmission."""

    frames: tuple[bytes, ...]
    start_s: float
    end_s: float
    sent: DownlinkPacket | None = None


class RequestRun:
    """One request and its answer.

    Attributes:
        asked_s: Time of the request.
        arrived_s: Time of the answer; None if none came.
        airtime_s: Air time of all packets between them.
    """

    def __init__(self, spec: RequestSpec) -> None:
        self._spec = spec
        self._rng = np.random.default_rng(spec.seed)
        self._uuv = UuvModemConfig(port="none", expected_loss=spec.loss, stream_bytes=_STREAM_BYTES, **spec.vehicle)
        self._op = OpModemConfig(port="none", vehicles={str(_VEHICLE): "uuv-1"}, **spec.vessel)
        self._vehicle = VehicleEndpoint("uuv-1", self._uuv)
        self._mac = self._uuv.new_mac()
        self._vessel = VesselLink("vessel-1", self._op)
        self._gate = TransmitGate(self._op)
        self._up: _Packet | None = None
        self._down: _Packet | None = None
        self._arriving: list[tuple[bool, _Packet]] = []
        self._previous_end_s: float | None = None
        # With the first contacts the vehicle learns that a vessel sends feedback, and the loss.
        self._due = [(1.0 + 100.0 * (n - 1), n, _LONGER * _STREAM_BYTES) for n in range(1, _FIRST_CONTACTS + 1)]
        self._next_contact_s = self._wait_s()
        self._contacts = _FIRST_CONTACTS
        self._answer = 1 if spec.kind == "refine" else 999
        self.asked_s = _FIRST_REQUEST_S + float(self._rng.uniform(0.0, 120.0))
        self._is_asked = False
        self.arrived_s: float | None = None
        self.airtime_s = 0.0

    def _wait_s(self) -> float:
        mean_s = self._spec.contact_every_s
        return float(self._rng.exponential(mean_s)) if mean_s else _LAST_S * 2

    def run(self) -> RequestRun:
        """Run until the answer has arrived."""
        now = 0.0
        while now < _LAST_S and self.arrived_s is None:
            now = round(now + _STEP_S, 3)
            self._arrive(now)
            self._new_images(now)
            self._send_up(now)
            self._send_down(now)
        return self

    def _new_images(self, now: float) -> None:
        if now >= self.asked_s and not self._is_asked:
            self._is_asked = True
            request = Command.model_validate(
                {
                    "command_id": "c-1",
                    "kind": self._spec.kind,
                    "vehicle_id": "uuv-1",
                    "image_id": image_of_number(1),
                    "issued_by": "operator",
                    "issued_utc_s": now,
                }
            )
            self._vessel.add(request, now)
        if now >= self._next_contact_s:
            self._contacts += 1
            self._due.append((now, self._contacts, _LONGER * _STREAM_BYTES))
            self._next_contact_s = now + self._wait_s()
        for due in [due for due in self._due if due[0] <= now]:
            self._due.remove(due)
            _, number, length = due
            shown = 1 if number == self._answer else number
            contact = ContactSummary(height_px=80, width_px=80, time_utc_s=float(shown))
            image = ImageToSend(image_of_number(number), f"c{shown}", contact, self._rng.bytes(length))
            self._vehicle.queue.add_image(image, now)

    # The channel

    def _collides(self, mine: _Packet | None, other: _Packet) -> bool:
        """Whether a modem transmitted while a packet arrived."""
        return mine is not None and mine.start_s < other.end_s + _TRAVEL_S and mine.end_s > other.start_s + _TRAVEL_S

    def _is_receiving(self, now: float, *, is_up: bool) -> bool:
        """Whether a packet of this direction is arriving."""
        return any(
            up == is_up and packet.start_s + _TRAVEL_S <= now < packet.end_s + _TRAVEL_S
            for up, packet in self._arriving
        )

    def _transmit(self, rate: RateInfo, frames: tuple[bytes, ...], now: float, *, is_up: bool) -> _Packet:
        packet = _Packet(frames, now, now + rate.airtime_s)
        self._arriving.append((is_up, packet))
        self.airtime_s += rate.airtime_s if self._is_asked else 0.0
        return packet

    def _arrive(self, now: float) -> None:
        for is_up, packet in [each for each in self._arriving if each[1].end_s + _TRAVEL_S <= now]:
            self._arriving.remove((is_up, packet))
            collides = self._collides(self._down if is_up else self._up, packet)
            kept = [frame for frame in packet.frames if self._rng.random() >= self._spec.loss and not collides]
            if is_up:
                self._receive_up(kept, now)
            elif kept:
                self._mac.channel_busy(now)
                self._receive_down(kept, now)

    def _receive_up(self, frames: Sequence[bytes], now: float) -> None:
        for frame in frames:
            self._gate.frame_received(now)
            content = self._vessel.endpoint.accept(_VEHICLE, frame, now)
            for update in content.images:
                long_enough = self._spec.kind != "refine" or update.received_bytes > _STREAM_BYTES + 30
                if self._is_asked and update.image_id == image_of_number(self._answer) and update.complete:
                    self.arrived_s = now if long_enough else self.arrived_s

    def _receive_down(self, frames: Sequence[bytes], now: float) -> None:
        for frame in frames:
            self._vehicle.receive(_VESSEL, frame, now)
            if self._vehicle.take_effects().counts["commands_received"] and self._spec.kind == "expand":
                self._due.append((now + _CODING_S, self._answer, _STREAM_BYTES))

    # The stations

    def _send_up(self, now: float) -> None:
        if self._up is not None:
            if now < self._up.end_s:
                return
            self._mac.sent(self._up.start_s, self._up.end_s)
            interval_s = now - (self._up.start_s if self._previous_end_s is None else self._previous_end_s)
            self._previous_end_s = now
            frames, self._up = self._up.frames, None
            self._vehicle.packet_sent(frames, interval_s)
        rate = self._uuv.rate_info(self._vehicle.queue.rate)
        if self._is_receiving(now, is_up=False) or (self._mac.wait_s(rate.airtime_s, now) or 0.0) > 0:
            return
        packet = self._vehicle.next_packet(now)
        if packet is None:
            self._previous_end_s = None
            return
        self._up = self._transmit(self._uuv.rate_info(packet.rate), packet.frames, now, is_up=True)

    def _send_down(self, now: float) -> None:
        if self._down is not None:
            if self._down.sent is not None and now >= self._down.end_s:
                self._vessel.endpoint.sent(self._down.sent, now)
                self._down.sent = None
            if now < self._down.end_s:
                return
        pending = self._vessel.endpoint.due_address(now) is not None
        if not self._gate.may_transmit(now, now, receiving=self._is_receiving(now, is_up=True), pending=pending):
            return
        rate = self._op.rate_info(self._op.downlink_rate)
        packet = self._vessel.endpoint.next_packet(rate.frames, rate.frame_bytes, now)
        if packet is not None:
            self._down = self._transmit(rate, packet.frames, now, is_up=False)
            self._down.sent = packet


def run_request(spec: RequestSpec) -> RequestRun:
    """Run one request; the same specification gives the same result."""
    return RequestRun(spec).run()


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser("request_times", "time from a request to its answer, simulated")
    parser.add_argument("--runs", type=int, default=30, help="runs with other seeds (%(default)s)")
    parser.add_argument("--loss", type=float, default=LOST_FRAMES, help="share of frames lost (%(default)s)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Run requests and print the times to the answer."""
    print(f"{'request':8} {'contacts':>8} {'median s':>8} {'90 %':>7} {'longest':>7} {'air s':>7}")
    for kind in ("expand", "refine"):
        for every_s in (0.0, 120.0):
            runs = [run_request(RequestSpec(kind, args.loss, every_s, seed)) for seed in range(args.runs)]
            times_s = [(one.arrived_s or np.inf) - one.asked_s for one in runs]
            air_s = statistics.median(one.airtime_s for one in runs)
            median_s, most_s = statistics.median(times_s), float(np.quantile(times_s, 0.9, method="higher"))
            print(f"{kind:8} {every_s:8.0f} {median_s:8.0f} {most_s:7.0f} {max(times_s):7.0f} {air_s:7.0f}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
