"""A day of several vehicles and one vessel in one water, on simulated time: queues, slots, losses, reports, restarts.

Everything but the modems and the processes is the real thing: each vehicle's `TransmitQueue`, medium access by slots,
the vessel's v1 receiver. Frames are lost in bursts by a chain of two states.
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
from sonarpost.errors import ConfigError
from sonarpost.link.config import QueueConfig, ReceiverConfig
from sonarpost.link.downlink.messages import image_of_number, number_of_image
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.payload_objects import Feedback
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.mac import Tdma
from sonarpost.link.queue.transmit_queue import TransmitQueue
from sonarpost.link.receiver import Event, ImageUpdate, MessageReceived
from sonarpost.link.sender import ImageToSend
from sonarpost.modem.micromodem import RATES

_SLOT_S: Final = 7.5
_GUARD_S: Final = 1.0
_RATE: Final = 1
_HOUR_S: Final = 3600.0
_REPORTS_A_SLOT: Final = 2
_KEPT: Final = 16
"""Pictures a vehicle remembers: few, so that a day shows whether memory is bounded."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages of one program.

    Attributes:
        source: The program.
        every_s: Mean time between messages, exponentially distributed.
        size_bytes: Of each.
        priority: See `TransmitQueue.add_message`.
        lifetime_s: See there.
    """

    source: str
    every_s: float
    size_bytes: int
    priority: int
    lifetime_s: float


USUAL: Final = (
    Traffic("alarm", 7200.0, 8, 1, 1800.0),
    Traffic("status", 600.0, 24, 4, 1800.0),
    Traffic("log", 1800.0, 50, 7, 21600.0),
)


@dataclass(frozen=True, slots=True)
class MissionSpec:
    """A mission.

    Attributes:
        vehicles: How many, 1..16.
        hours: How long.
        loss: Share of frames lost, both ways.
        burst_frames: Mean length of a run of lost frames.
        contact_every_s: Mean time between contacts of a vehicle.
        stream_bytes: Of a picture.
        deaf_hours: How long from the beginning the vehicles hear nothing of the vessel.
        traffic: Other messages of every vehicle.
        seed: Of everything drawn.

    Raises:
        ConfigError: A value out of range.
    """

    vehicles: int = 8
    hours: float = 24.0
    loss: float = 0.3
    burst_frames: float = 2.0
    contact_every_s: float = 1800.0
    stream_bytes: int = 300
    deaf_hours: float = 0.0
    traffic: tuple[Traffic, ...] = USUAL
    seed: int = 1

    def __post_init__(self) -> None:
        for name, low, high in (
            ("vehicles", 1, 16),
            ("hours", 0.1, 240),
            ("loss", 0.0, 0.9),
            ("burst_frames", 1, 100),
            ("deaf_hours", 0, 240),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError("mission", name, value, f"{low}..{high}")


@dataclass(slots=True)
class Account:
    """What became of one kind of traffic.

    Attributes:
        offered: How many there were.
        delays_s: Of those that arrived, from being offered to arriving.
    """

    offered: int = 0
    delays_s: list[float] = field(default_factory=list)

    @property
    def delivered(self) -> float:
        """Share that arrived, 1 where there were none."""
        return len(self.delays_s) / self.offered if self.offered else 1.0


@dataclass(frozen=True, slots=True)
class MissionResult:
    """What became of everything.

    Attributes:
        messages: By program.
        previews: Contacts of which at least record and coarse picture arrived.
        pictures: Those of which all that the vehicle had arrived.
        unfinished_at: When those that are not whole were offered, hours of the mission.
        left: Pictures and messages still waiting at the end.
        expired: Messages dropped because their time was over.
        frames_sent: By the vehicles.
        state_bytes: Of all queues and the receiver together, every hour.
        restarts: How often a vehicle's queue was saved and taken up by another.
    """

    messages: Mapping[str, Account]
    previews: Account
    pictures: Account
    unfinished_at: Sequence[float]
    left: int
    expired: int
    frames_sent: int
    state_bytes: Sequence[int]
    restarts: int


class _Water:
    """Loses frames in bursts, each path by itself."""

    def __init__(self, loss: float, burst_frames: float, rng: np.random.Generator) -> None:
        self._end = 1.0 / burst_frames
        self._begin = min(1.0, self._end * loss / (1.0 - loss))
        self._bad: dict[int, bool] = {}
        self._rng = rng

    def loses(self, path: int) -> bool:
        bad = self._bad.get(path, False)
        chance = 1.0 - self._end if bad else self._begin
        self._bad[path] = bool(self._rng.random() < chance)
        return self._bad[path]


class _Vehicle:
    def __init__(self, address: int, spec: MissionSpec, rng: np.random.Generator) -> None:
        self.address = address
        self._spec = spec
        self._rng = rng
        self.config = QueueConfig(
            rates=(_RATE,), first_rate=_RATE, expected_loss=spec.loss, group_delay_s=60.0, kept_images=_KEPT
        )
        self.queue = TransmitQueue(self.config)
        self.number = 0
        self.due = [rng.exponential(t.every_s) for t in spec.traffic]
        self.contact_due = float(rng.exponential(spec.contact_every_s))
        self.last_due = spec.hours * _HOUR_S - 2 * _HOUR_S  # the rest of the time is for what still waits

    def restart(self) -> None:
        """Save the queue and take it up as another process does."""
        parts = self.queue.parts()
        self.queue = TransmitQueue(self.config)
        assert not self.queue.restore(parts)

    def work(self, now: float, mission: _Mission) -> None:
        for place, traffic in enumerate(self._spec.traffic):
            while self.due[place] <= now and self.due[place] < self.last_due:
                data = mission.offer(traffic.source, self.due[place], traffic.size_bytes)
                name = data[:6].hex()
                self.queue.add_message(
                    name, traffic.source, data, now, priority=traffic.priority, lifetime_s=traffic.lifetime_s
                )
                self.due[place] += float(self._rng.exponential(traffic.every_s))
        while self.contact_due <= now and self.contact_due < self.last_due:
            self.number += 1
            contact = ContactSummary(height_px=80, width_px=80, time_utc_s=round(self.contact_due))
            stream = self._rng.bytes(self._spec.stream_bytes)
            image_id, contact_id = image_of_number(self.number), f"{self.address}-{self.number}"
            self.queue.add_image(ImageToSend(image_id, contact_id, contact, stream), now)
            mission.offer_picture((self.address, self.number), self.contact_due, stream)
            self.contact_due += float(self._rng.exponential(self._spec.contact_every_s))


class _Mission:
    def __init__(self, spec: MissionSpec) -> None:
        self._rng = np.random.default_rng(spec.seed)
        self.water = _Water(spec.loss, spec.burst_frames, self._rng)
        self.messages = {t.source: Account() for t in spec.traffic}
        self.previews, self.pictures = Account(), Account()
        self._offered: dict[bytes, tuple[str, float]] = {}
        self._pictures: dict[tuple[int, int], tuple[float, bytes]] = {}
        self._seen: set[tuple[int, int]] = set()
        self._count = 0

    def offer(self, source: str, at: float, size_bytes: int) -> bytes:
        self._count += 1
        data = self._count.to_bytes(6, "big").ljust(size_bytes, b".")
        self._offered[data] = (source, at)
        self.messages[source].offered += 1
        return data

    def offer_picture(self, name: tuple[int, int], at: float, stream: bytes) -> None:
        self._pictures[name] = (at, stream)
        self.previews.offered += 1
        self.pictures.offered += 1

    def unfinished_at(self) -> list[float]:
        return sorted(at / _HOUR_S for at, _ in self._pictures.values())

    def arrived(self, event: Event, now: float) -> None:
        if isinstance(event, MessageReceived) and event.data in self._offered:
            source, at = self._offered.pop(event.data)
            self.messages[source].delays_s.append(now - at)
        elif isinstance(event, ImageUpdate):
            name = (event.source, number_of_image(event.image_id))
            if name not in self._pictures:
                return
            at, stream = self._pictures[name]
            if name not in self._seen:
                self._seen.add(name)
                self.previews.delays_s.append(now - at)
            if event.stream == stream:
                self.pictures.delays_s.append(now - at)
                del self._pictures[name]


def run_mission(spec: MissionSpec) -> MissionResult:
    """Run a mission; the same specification gives the same result.

    The first vehicle's slot is first in a frame of slots, the vessel's reports have the last. Once an hour one of the
    vehicles is restarted in the middle of its traffic.
    """
    rng = np.random.default_rng([spec.seed, 1])
    mission = _Mission(spec)
    vehicles = [_Vehicle(n + 1, spec, rng) for n in range(spec.vehicles)]
    frame_s = (spec.vehicles + 1) * _SLOT_S
    slots = [Tdma(frame_s, n * _SLOT_S, _SLOT_S, _GUARD_S) for n in range(spec.vehicles)]
    receiver = V1Receiver(ReceiverConfig(max_sources=16))
    now, hour, restarts = 0.0, 0, 0
    state_bytes: list[int] = []
    while now < spec.hours * _HOUR_S:
        if now >= hour * _HOUR_S:
            vehicles[hour % spec.vehicles].restart()
            restarts += 1
            hour += 1
            state_bytes.append(_state_bytes(vehicles, receiver))
        for vehicle, slot in zip(vehicles, slots, strict=True):
            now += slot.wait_s(RATES[_RATE].airtime_s, now) or 0.0
            vehicle.work(now, mission)
            packet = vehicle.queue.next_packet(now)
            now += RATES[_RATE].airtime_s
            frames = packet.frames if packet else ()
            for frame in frames:
                if not mission.water.loses(vehicle.address):
                    for event in receiver.accept(vehicle.address, frame, now):
                        mission.arrived(event, now)
            vehicle.queue.sent(frames, frame_s)
        _report(vehicles, receiver, mission.water, now, deaf=now < spec.deaf_hours * _HOUR_S)
        now = (now // frame_s + 1) * frame_s
    return MissionResult(
        messages=mission.messages,
        previews=mission.previews,
        pictures=mission.pictures,
        unfinished_at=mission.unfinished_at(),
        left=sum(len(v.queue.open_numbers()) + len(v.queue.messages.waiting) for v in vehicles),
        expired=sum(v.queue.messages.expired for v in vehicles),
        frames_sent=sum(v.queue.sender.state.frames_sent for v in vehicles),
        state_bytes=state_bytes,
        restarts=restarts,
    )


def _report(vehicles: Sequence[_Vehicle], receiver: V1Receiver, water: _Water, now: float, *, deaf: bool) -> None:
    """Let the vessel report to the vehicles that need it most, as many as its slot holds."""
    sent = 0
    for vehicle in sorted(vehicles, key=lambda v: v.queue.last_feedback_s or -1.0):
        if sent == _REPORTS_A_SLOT:
            return
        if not receiver.feedback_is_due(vehicle.address, now):
            continue
        report = receiver.feedback(vehicle.address, now)
        sent += 1
        if isinstance(report, Feedback) and not water.loses(-vehicle.address) and not deaf:
            vehicle.queue.on_feedback(report, now, 100)


def _state_bytes(vehicles: Sequence[_Vehicle], receiver: V1Receiver) -> int:
    queues = sum(len(part) for v in vehicles for part in v.queue.parts().values())
    return queues + sum(len(part) for part in receiver.parts().values())


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    usual = MissionSpec()
    parser = command_parser("mission", "a day of several vehicles' traffic through one water, simulated")
    parser.add_argument("--vehicles", type=int, default=usual.vehicles, help="1 to 16 (%(default)s)")
    parser.add_argument("--hours", type=float, default=usual.hours, help="how long (%(default)s)")
    parser.add_argument("--loss", type=float, default=usual.loss, help="share of frames lost (%(default)s)")
    parser.add_argument("--burst", type=float, default=usual.burst_frames, help="mean run of lost frames (%(default)s)")
    parser.add_argument("--seed", type=int, default=usual.seed, help="of everything drawn (%(default)s)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Run a mission and print what became of it."""
    spec = MissionSpec(args.vehicles, args.hours, args.loss, args.burst, seed=args.seed)
    result = run_mission(spec)
    print(f"{'':12} {'offered':>8} {'arrived':>8} {'median s':>9} {'longest s':>10}")
    for name, account in (*result.messages.items(), ("previews", result.previews), ("pictures", result.pictures)):
        print(_line(name, account))
    print(f"{result.frames_sent} frames sent, {result.restarts} restarts, {result.expired} messages expired")
    print(f"{result.left} left; state {max(result.state_bytes) / 1000:.0f} kB at most")
    return 0


def _line(name: str, account: Account) -> str:
    delays_s = account.delays_s or [0.0]
    times = f"{statistics.median(delays_s):9.0f} {max(delays_s):10.0f}"
    return f"{name:12} {account.offered:8} {account.delivered:8.4f} {times}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
