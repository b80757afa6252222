"""`python -m research.mission`: a day of traffic of several vehicles to one vessel, on simulated time.

Each vehicle has its `TransmitQueue` with TDMA, the vessel has its v1 receiver; modems and processes are not simulated.
Frames are lost in bursts (Gilbert-Elliott), feedback is sent in the vessel's slot, and vehicles restart.
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
_FEEDBACK_PER_SLOT: Final = 2
_KEPT_IMAGES: Final = 16
"""Images kept by a vehicle: few, so that a day shows whether memory is bounded."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """Messages of one program.

    Attributes:
        source: Name of the program.
        every_s: Mean time between messages, exponentially distributed.
        size_bytes: Size of a message.
        priority: See `TransmitQueue.add_message`.
        lifetime_s: See `TransmitQueue.add_message`.
    """

    source: str
    every_s: float
    size_bytes: int
    priority: int
    lifetime_s: float


DEFAULT_TRAFFIC: Final = (
    Traffic("alarm", 7200.0, 8, 1, 1800.0),
    Traffic("status", 600.0, 24, 4, 1800.0),
    Traffic("log", 1800.0, 50, 7, 21600.0),
)


@dataclass(frozen=True, slots=True)
class MissionSpec:
    """Parameters of a mission.

    Attributes:
        vehicles: Number of vehicles, 1..16.
        hours: Duration.
        loss: Share of frames lost in both directions.
        burst_frames: Mean length of a run of lost frames.
        contact_every_s: Mean time between contacts of a vehicle.
        stream_bytes: Length of an image's stream.
        verdict_share: Share of the contacts on which the operator gives a final verdict from the preview.
        verdict_delay_s: Time from the preview to the verdict.
        no_downlink_hours: Time from the start in which the vehicles receive nothing from the vessel.
        traffic: Messages of every vehicle.
        seed: Seed of all random draws.

    Raises:
        ConfigError: A value out of range.
    """

    vehicles: int = 8
    hours: float = 24.0
    loss: float = 0.3
    burst_frames: float = 2.0
    contact_every_s: float = 1800.0
    stream_bytes: int = 300
    verdict_share: float = 0.0
    verdict_delay_s: float = 60.0
    no_downlink_hours: float = 0.0
    traffic: tuple[Traffic, ...] = DEFAULT_TRAFFIC
    seed: int = 1

    def __post_init__(self) -> None:
        for name, low, high in (
            ("vehicles", 1, 16),
            ("hours", 0.1, 240),
            ("loss", 0.0, 0.9),
            ("burst_frames", 1, 100),
            ("no_downlink_hours", 0, 240),
            ("verdict_share", 0, 1),
            ("verdict_delay_s", 0, 86400),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError("mission", name, value, f"{low}..{high}")


@dataclass(slots=True)
class TrafficResult:
    """Result of one kind of traffic.

    Attributes:
        offered: Number of messages or images offered.
        delays_s: Delays of those that arrived.
    """

    offered: int = 0
    delays_s: list[float] = field(default_factory=list)

    @property
    def delivered(self) -> float:
        """Share that arrived; 1 if none was offered."""
        return len(self.delays_s) / self.offered if self.offered else 1.0


@dataclass(frozen=True, slots=True)
class MissionResult:
    """Result of a mission.

    Attributes:
        messages: Results by program.
        previews: Contacts of which at least the record and a coarse image arrived.
        images: Images that arrived completely; `offered` without the stopped ones.
        stopped: Images that a verdict stopped before they had arrived completely.
        unfinished_at: Offer times of incomplete images, in hours of the mission.
        left: Images and messages still queued at the end.
        expired: Messages deleted after their lifetime.
        frames_sent: Frames sent by the vehicles.
        packets_sent: Packets sent by the vehicles.
        state_bytes: State of all queues and the receiver, every hour.
        restarts: Number of restarts of a vehicle.
    """

    messages: Mapping[str, TrafficResult]
    previews: TrafficResult
    images: TrafficResult
    stopped: int
    unfinished_at: Sequence[float]
    left: int
    expired: int
    frames_sent: int
    packets_sent: int
    state_bytes: Sequence[int]
    restarts: int


class _LossyChannel:
    """Frame losses in bursts (Gilbert-Elliott), independent for each path."""

    def __init__(self, loss: float, burst_frames: float, rng: np.random.Generator) -> None:
        self._end = 1.0 / burst_frames
        self._begin = min(1.0, self._end * loss / (1.0 - loss))
        self._in_burst: dict[int, bool] = {}
        self._rng = rng

    def loses(self, path: int) -> bool:
        in_burst = self._in_burst.get(path, False)
        probability = 1.0 - self._end if in_burst else self._begin
        self._in_burst[path] = bool(self._rng.random() < probability)
        return self._in_burst[path]


class _Vehicle:
    def __init__(self, address: int, spec: MissionSpec, rng: np.random.Generator) -> None:
        self.address = address
        self._spec = spec
        self._rng = rng
        self.config = QueueConfig(
            rates=(RATES[_RATE],),
            first_rate=_RATE,
            expected_loss=spec.loss,
            group_delay_s=60.0,
            kept_images=_KEPT_IMAGES,
        )
        self.queue = TransmitQueue(self.config)
        self.number = 0
        self.due = [rng.exponential(t.every_s) for t in spec.traffic]
        self.contact_due = float(rng.exponential(spec.contact_every_s))
        self.last_due = spec.hours * _HOUR_S - 2 * _HOUR_S  # afterwards the queues are emptied

    def restart(self) -> None:
        """Save the state of the queue and restore it into a new one."""
        parts = self.queue.parts()
        self.queue = TransmitQueue(self.config)
        assert not self.queue.restore(parts)

    def add_due_traffic(self, now: float, mission: _Mission) -> None:
        for index, traffic in enumerate(self._spec.traffic):
            while self.due[index] <= now and self.due[index] < self.last_due:
                data = mission.offer(traffic.source, self.due[index], traffic.size_bytes)
                name = data[:6].hex()
                self.queue.add_message(
                    name, traffic.source, data, now, priority=traffic.priority, lifetime_s=traffic.lifetime_s
                )
                self.due[index] += float(self._rng.exponential(traffic.every_s))
        while self.contact_due <= now and self.contact_due < self.last_due:
            self.number += 1
            contact = ContactSummary(height_px=80, width_px=80, time_utc_s=round(self.contact_due))
            stream = self._rng.bytes(self._spec.stream_bytes)
            image_id, contact_id = image_of_number(self.number), f"{self.address}-{self.number}"
            self.queue.add_image(ImageToSend(image_id, contact_id, contact, stream), now)
            mission.offer_image((self.address, self.number), self.contact_due, stream)
            self.contact_due += float(self._rng.exponential(self._spec.contact_every_s))


class _Mission:
    def __init__(self, spec: MissionSpec) -> None:
        self._rng = np.random.default_rng(spec.seed)
        self.channel = _LossyChannel(spec.loss, spec.burst_frames, self._rng)
        self.messages = {t.source: TrafficResult() for t in spec.traffic}
        self.previews, self.images = TrafficResult(), TrafficResult()
        self._offered: dict[bytes, tuple[str, float]] = {}
        self._open_images: dict[tuple[int, int], tuple[float, bytes]] = {}
        self._with_preview: set[tuple[int, int]] = set()
        self._count = 0
        self._spec = spec
        self._verdict_rng = np.random.default_rng([spec.seed, 2])
        self._verdicts: list[tuple[float, tuple[int, int]]] = []
        self.stopped = 0

    def offer(self, source: str, at: float, size_bytes: int) -> bytes:
        self._count += 1
        data = self._count.to_bytes(6, "big").ljust(size_bytes, b".")
        self._offered[data] = (source, at)
        self.messages[source].offered += 1
        return data

    def offer_image(self, name: tuple[int, int], at: float, stream: bytes) -> None:
        self._open_images[name] = (at, stream)
        self.previews.offered += 1
        self.images.offered += 1

    def unfinished_at(self) -> list[float]:
        return sorted(at / _HOUR_S for at, _ in self._open_images.values())

    def handle(self, event: Event, now: float) -> None:
        if isinstance(event, MessageReceived) and event.data in self._offered:
            source, at = self._offered.pop(event.data)
            self.messages[source].delays_s.append(now - at)
        elif isinstance(event, ImageUpdate):
            name = (event.source, number_of_image(event.image_id))
            if name not in self._open_images:
                return
            at, stream = self._open_images[name]
            if name not in self._with_preview:
                self._with_preview.add(name)
                self.previews.delays_s.append(now - at)
                if self._verdict_rng.random() < self._spec.verdict_share:
                    self._verdicts.append((now + self._spec.verdict_delay_s, name))
            if event.stream == stream:
                self.images.delays_s.append(now - at)
                del self._open_images[name]

    def send_verdicts(self, vehicles: Sequence[_Vehicle], now: float, *, is_lost: bool) -> None:
        """Send the verdicts that are due; each is repeated in every slot until it arrives."""
        for due_s, name in list(self._verdicts):
            if due_s > now or is_lost or self.channel.loses(-name[0]):
                continue
            self._verdicts.remove((due_s, name))
            if name in self._open_images and vehicles[name[0] - 1].queue.stop(name[1]):
                del self._open_images[name]
                self.images.offered -= 1
                self.stopped += 1


def run_mission(spec: MissionSpec) -> MissionResult:
    """Run a mission; the same specification gives the same result.

    In each TDMA cycle the vehicles have the first slots, the vessel the last one. Once an hour one vehicle restarts.
    """
    rng = np.random.default_rng([spec.seed, 1])
    mission = _Mission(spec)
    vehicles = [_Vehicle(n + 1, spec, rng) for n in range(spec.vehicles)]
    cycle_s = (spec.vehicles + 1) * _SLOT_S
    slots = [Tdma(cycle_s, n * _SLOT_S, (n + 1) * _SLOT_S - _GUARD_S) for n in range(spec.vehicles)]
    receiver = V1Receiver(ReceiverConfig(max_sources=16))
    now, hour, restarts, packets = 0.0, 0, 0, 0
    state_bytes: list[int] = []
    while now < spec.hours * _HOUR_S:
        if now >= hour * _HOUR_S:
            vehicles[hour % spec.vehicles].restart()
            restarts += 1
            hour += 1
            state_bytes.append(_state_bytes(vehicles, receiver))
        for vehicle, slot in zip(vehicles, slots, strict=True):
            now += slot.wait_s(RATES[_RATE].airtime_s, now) or 0.0
            vehicle.add_due_traffic(now, mission)
            packet = vehicle.queue.next_packet(now)
            now += RATES[_RATE].airtime_s
            frames = packet.frames if packet else ()
            packets += packet is not None
            for frame in frames:
                if not mission.channel.loses(vehicle.address):
                    for event in receiver.accept(vehicle.address, frame, now):
                        mission.handle(event, now)
            vehicle.queue.sent(frames, cycle_s)
        is_lost = now < spec.no_downlink_hours * _HOUR_S
        mission.send_verdicts(vehicles, now, is_lost=is_lost)
        _send_feedback(vehicles, receiver, mission.channel, now, is_lost=is_lost)
        now = (now // cycle_s + 1) * cycle_s
    return MissionResult(
        messages=mission.messages,
        previews=mission.previews,
        images=mission.images,
        stopped=mission.stopped,
        unfinished_at=mission.unfinished_at(),
        left=sum(len(v.queue.open_numbers()) + len(v.queue.messages.waiting) for v in vehicles),
        expired=sum(v.queue.messages.expired for v in vehicles),
        frames_sent=sum(v.queue.sender.state.frames_sent for v in vehicles),
        packets_sent=packets,
        state_bytes=state_bytes,
        restarts=restarts,
    )


def _send_feedback(
    vehicles: Sequence[_Vehicle], receiver: V1Receiver, channel: _LossyChannel, now: float, *, is_lost: bool
) -> None:
    """Send feedback to the vehicles with the oldest feedback, as many as fit into the slot."""
    sent = 0
    for vehicle in sorted(vehicles, key=lambda v: v.queue.last_feedback_s or -1.0):
        if sent == _FEEDBACK_PER_SLOT:
            return
        if not receiver.feedback_is_due(vehicle.address, now):
            continue
        feedback = receiver.feedback(vehicle.address, now)
        sent += 1
        if isinstance(feedback, Feedback) and not channel.loses(-vehicle.address) and not is_lost:
            vehicle.queue.on_feedback(feedback, now, 100)


def _state_bytes(vehicles: Sequence[_Vehicle], receiver: V1Receiver) -> int:
    queues = sum(len(part) for v in vehicles for part in v.queue.parts().values())
    return queues + sum(len(part) for part in receiver.parts().values())


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    default = MissionSpec()
    parser = command_parser("mission", "a day of traffic of several vehicles, simulated")
    parser.add_argument("--vehicles", type=int, default=default.vehicles, help="1 to 16 (%(default)s)")
    parser.add_argument("--hours", type=float, default=default.hours, help="duration (%(default)s)")
    parser.add_argument("--loss", type=float, default=default.loss, help="share of frames lost (%(default)s)")
    parser.add_argument("--burst", type=float, default=default.burst_frames, help="mean length of a loss (%(default)s)")
    parser.add_argument(
        "--contact-every", type=float, default=default.contact_every_s, help="seconds between contacts (%(default)s)"
    )
    parser.add_argument("--stream-bytes", type=int, default=default.stream_bytes, help="of each image (%(default)s)")
    parser.add_argument(
        "--verdict-share", type=float, default=0.0, help="share of the contacts decided on the preview (%(default)s)"
    )
    parser.add_argument(
        "--verdict-delay", type=float, default=default.verdict_delay_s, help="seconds after it (%(default)s)"
    )
    parser.add_argument("--seed", type=int, default=default.seed, help="seed of all random draws (%(default)s)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Run a mission and print its results."""
    spec = MissionSpec(
        vehicles=args.vehicles,
        hours=args.hours,
        loss=args.loss,
        burst_frames=args.burst,
        contact_every_s=args.contact_every,
        stream_bytes=args.stream_bytes,
        verdict_share=args.verdict_share,
        verdict_delay_s=args.verdict_delay,
        seed=args.seed,
    )
    result = run_mission(spec)
    print(f"{'':12} {'offered':>8} {'arrived':>8} {'median s':>9} {'longest s':>10}")
    for name, traffic in (*result.messages.items(), ("previews", result.previews), ("images", result.images)):
        print(_line(name, traffic))
    airtime_s = result.packets_sent * RATES[_RATE].airtime_s
    print(f"{airtime_s:.0f} s of air time of the vehicles; {result.stopped} images stopped by a verdict")
    print(f"{result.frames_sent} frames sent, {result.restarts} restarts, {result.expired} messages expired")
    print(f"{result.left} left; state {max(result.state_bytes) / 1000:.0f} kB at most")
    return 0


def _line(name: str, traffic: TrafficResult) -> str:
    delays_s = traffic.delays_s or [0.0]
    times = f"{statistics.median(delays_s):9.0f} {max(delays_s):10.0f}"
    return f"{name:12} {traffic.offered:8} {traffic.delivered:8.4f} {times}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
