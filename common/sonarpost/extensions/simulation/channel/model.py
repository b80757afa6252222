"""Acoustic propagation between modems: travel time, half duplex, collisions, loss, fading and damage.

The model does no input or output and reads no clock: packets and `now` go in, events come out. Its rules and their
sources are in docs/explanation/channel-model.md. Packet draws depend only on (seed, transmitter, packet number,
receiver, frame), fades only on (seed, path, time), so a run can be repeated.
"""

import hashlib
import heapq
import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition, frame_error_rate, transmission_loss_db
from sonarpost.extensions.simulation.channel.events import (
    AcousticPacket,
    ArrivalEnded,
    ArrivalStarted,
    FrameArrival,
    FrameOutcome,
    PacketOutcome,
    TransmittedPacket,
)
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters, TailDamage

DETECTION_SNR_DB = -12.0
"""With `range_loss`, packets below this signal-to-noise ratio are not detected."""


@dataclass(frozen=True, slots=True)
class RandomDraws:
    """Random draws for one packet on its way to one receiver.

    A draw is a keyed hash of its subject, not the next number of a generator. It is the same on every platform and
    Python version, independent of other draws.

    Attributes:
        seed: Seed of the simulation.
        transmitter: Number of the transmitting modem.
        packet: Count of that modem's packets, from 1.
        receiver: Number of the receiving modem.
    """

    seed: int
    transmitter: int
    packet: int
    receiver: int

    def uniform(self, purpose: str, frame: int = 0) -> float:
        """Return a number in [0, 1), the same for the same purpose and frame."""
        return int.from_bytes(self.noise(7, purpose, frame), "big") / 2**56

    def happens(self, probability: float, purpose: str, frame: int = 0) -> bool:
        """Return whether an event of that probability happens: never at 0, always at 1."""
        return self.uniform(purpose, frame) < probability

    def noise(self, count: int, purpose: str, frame: int = 0) -> bytes:
        """Return `count` random bytes."""
        key = f"{self.seed}|{self.transmitter}|{self.packet}|{self.receiver}|{frame}|{purpose}"
        return hashlib.shake_128(key.encode("ascii")).digest(count)


def damage_tail(frame: bytes, draws: RandomDraws, number: int, kind: TailDamage, longest_fraction: float) -> bytes:
    """Return `frame` with its tail replaced, of the same length.

    The tail has between one byte and `longest_fraction` of the frame. Zeros over bytes that were already zero leave the
    frame unchanged.

    Args:
        frame: The bytes sent, at least one.
        draws: The draws of this packet.
        number: The frame's number, from 1.
        kind: Zeros, noise, or an even draw of the two.
        longest_fraction: Longest tail as a fraction of the frame, above 0 and at most 1.
    """
    longest = max(1, int(len(frame) * longest_fraction))
    tail = 1 + min(longest - 1, int(draws.uniform("tail length", number) * longest))
    zeros = kind is TailDamage.ZEROS or (kind is TailDamage.EITHER and draws.happens(0.5, "tail kind", number))
    return frame[:-tail] + (bytes(tail) if zeros else draws.noise(tail, "tail noise", number))


class Fading:
    """Burst fading of every path after Gilbert (1960) and Elliott (1963), in continuous time.

    A path is clear or faded, and clear at time zero. The duration of each state is exponentially distributed. Both
    directions of a path fade together. A mean fade of 0 s disables fading.
    """

    def __init__(self, seed: int, mean_clear_s: float, mean_fade_s: float) -> None:
        self._seed = seed
        self._means_s = (mean_clear_s, mean_fade_s)
        # Times at which each path changes its state; the first change starts a fade.
        self._changes: dict[tuple[int, int], list[float]] = {}

    def faded(self, one: int, other: int, time_s: float) -> bool:
        """Return whether the path between two modems is faded at a time."""
        if self._means_s[1] <= 0.0:
            return False
        path = (min(one, other), max(one, other))
        changes = self._changes.setdefault(path, [])
        while not changes or changes[-1] <= time_s:
            draws = RandomDraws(self._seed, path[0], len(changes), path[1])
            mean_s = self._means_s[len(changes) % 2]
            # 1 - u is above 0, so the logarithm is finite. The minimum keeps the loop moving.
            duration_s = max(1e-3, -mean_s * math.log(1.0 - draws.uniform("fading")))
            changes.append((changes[-1] if changes else 0.0) + duration_s)
        return bisect_right(changes, time_s) % 2 == 1


@dataclass(slots=True)
class _PendingArrival:
    """A transmission at one receiver, `start_s` to `end_s`."""

    receiver: int
    transmission: TransmittedPacket
    start_s: float
    end_s: float
    range_m: float
    snr_db: float
    lost: bool
    detected: bool = False
    resolved: bool = False


@dataclass(slots=True)
class _ModemState:
    """Position of one modem, and its recent transmissions and arrivals."""

    position: LocalPosition
    sent: int = 0
    transmissions: list[TransmittedPacket] = field(default_factory=list)
    arrivals: list[_PendingArrival] = field(default_factory=list)


class ChannelModel:
    """The acoustic channel shared by any number of modems, whose positions are given by their numbers."""

    def __init__(self, parameters: ChannelParameters, positions: Mapping[int, LocalPosition]) -> None:
        self.parameters = parameters
        self._modems = {modem: _ModemState(position) for modem, position in positions.items()}
        # (time, 0 for an end and 1 for a start, order, arrival): ends come first, as touching is not overlapping.
        self._events: list[tuple[float, int, int, _PendingArrival]] = []
        self._order = 0
        self._fading = Fading(parameters.seed, parameters.mean_clear_s, parameters.mean_fade_s)
        self._reference_snr_db = parameters.reference_snr_db
        self._absorption_db_per_km = parameters.absorption_db_per_km

    @property
    def in_flight(self) -> int:
        """Number of arrivals that have not ended."""
        return sum(not arrival.resolved for modem in self._modems.values() for arrival in modem.arrivals)

    def travel_times_s(self, modem: int, places: Mapping[str, LocalPosition]) -> dict[str, float]:
        """Return the one-way travel time, in seconds, from a modem to named places."""
        own = self._modems[modem].position
        return {name: own.range_m(place) / self.parameters.sound_speed_m_per_s for name, place in places.items()}

    def next_event_s(self) -> float | None:
        """Return the simulated time of the next event, or None when no packet is in flight."""
        return self._events[0][0] if self._events else None

    def transmit(self, modem: int, packet: AcousticPacket, now: float) -> TransmittedPacket:
        """Transmit a packet at `now`.

        Raises:
            ValueError: The modem is still transmitting, or `airtime_s` is not above zero.
        """
        transmitter = self._modems[modem]
        self._prune(transmitter, now)
        if packet.airtime_s <= 0:
            raise ValueError(f"airtime_s: got {packet.airtime_s!r}, expected above 0")
        if any(now < sent.ended_s for sent in transmitter.transmissions):
            raise ValueError(
                f"modem {modem} transmits until {transmitter.transmissions[-1].ended_s}, not again at {now}"
            )
        transmitter.sent += 1
        sent = TransmittedPacket(modem, transmitter.sent, packet, now, now + packet.airtime_s)
        transmitter.transmissions.append(sent)
        for receiver, other in self._modems.items():
            if receiver != modem:
                self._schedule_arrival(receiver, other, sent, transmitter.position)
        return sent

    def poll(self, now: float) -> list[ArrivalStarted | ArrivalEnded]:
        """Return the events up to and including `now`, in order of time."""
        events: list[ArrivalStarted | ArrivalEnded] = []
        while self._events and self._events[0][0] <= now:
            time_s, is_start, _, arrival = heapq.heappop(self._events)
            if not is_start:
                events.append(self._resolve(arrival, time_s))
            elif self._detect(arrival, time_s):
                events.append(ArrivalStarted(arrival.receiver, time_s, arrival.transmission))
        return events

    def snr_db(self, range_m: float) -> float:
        """Return the mean signal-to-noise ratio at a range, dB."""
        loss_db = transmission_loss_db(range_m, self._absorption_db_per_km, self.parameters.spreading_db_per_decade)
        return self._reference_snr_db - loss_db

    def _schedule_arrival(
        self, receiver: int, modem: _ModemState, sent: TransmittedPacket, origin: LocalPosition
    ) -> None:
        p = self.parameters
        range_m = origin.range_m(modem.position)
        start_s = sent.started_s + range_m / p.sound_speed_m_per_s
        draws = RandomDraws(p.seed, sent.transmitter, sent.number, receiver)
        snr_db = self.snr_db(range_m) + p.snr_spread_db * (2 * draws.uniform("snr") - 1)
        fade_db = p.fade_depth_db if self._fading.faded(sent.transmitter, receiver, start_s) else 0.0
        lost = draws.happens(p.packet_loss, "packet loss") or (p.range_loss and snr_db - fade_db < DETECTION_SNR_DB)
        if not sent.packet.frames:  # an acknowledgement or mini-packet is lost like a frame, and is then not detected
            lost = lost or draws.happens(self._frame_loss(sent, receiver, snr_db, start_s), "lost frame")
        end_s = start_s + sent.packet.airtime_s
        arrival = _PendingArrival(receiver, sent, start_s, end_s, range_m, snr_db, lost)
        modem.arrivals.append(arrival)
        for time_s, is_start in ((start_s, 1), (end_s, 0)):
            self._order += 1
            heapq.heappush(self._events, (time_s, is_start, self._order, arrival))

    def _frame_loss(self, sent: TransmittedPacket, receiver: int, snr_db: float, time_s: float) -> float:
        """Return the probability that a frame arriving at `time_s` is lost by any of the three causes."""
        p = self.parameters
        faded = self._fading.faded(sent.transmitter, receiver, time_s)
        snr_db -= p.fade_depth_db if faded else 0.0
        by_range = frame_error_rate(sent.packet.rate, snr_db) if p.range_loss else 0.0
        by_fade = p.fade_loss if faded else 0.0
        return 1.0 - (1.0 - p.frame_loss) * (1.0 - by_range) * (1.0 - by_fade)

    def _detect(self, arrival: _PendingArrival, time_s: float) -> bool:
        modem = self._modems[arrival.receiver]
        transmitting = any(sent.started_s <= time_s < sent.ended_s for sent in modem.transmissions)
        receiving = any(other.detected and not other.resolved for other in modem.arrivals)
        arrival.detected = not (arrival.lost or transmitting or receiving)
        return arrival.detected

    def _resolve(self, arrival: _PendingArrival, time_s: float) -> ArrivalEnded:
        arrival.resolved = True
        outcome = self._outcome(arrival)
        self._prune(self._modems[arrival.receiver], time_s)
        return ArrivalEnded(
            receiver=arrival.receiver,
            time_s=time_s,
            transmission=arrival.transmission,
            outcome=outcome,
            detected=arrival.detected,
            frames=self._frames(arrival, outcome),
            range_m=arrival.range_m,
            snr_db=arrival.snr_db,
            delay_s=arrival.start_s - arrival.transmission.started_s,
        )

    def _outcome(self, arrival: _PendingArrival) -> PacketOutcome:
        modem = self._modems[arrival.receiver]
        if any(sent.started_s < arrival.end_s and arrival.start_s < sent.ended_s for sent in modem.transmissions):
            return PacketOutcome.TRANSMITTING
        if any(
            other is not arrival and other.start_s < arrival.end_s and arrival.start_s < other.end_s
            for other in modem.arrivals
        ):
            return PacketOutcome.COLLISION
        return PacketOutcome.LOST if arrival.lost else PacketOutcome.ARRIVED

    def _frames(self, arrival: _PendingArrival, outcome: PacketOutcome) -> tuple[FrameArrival, ...]:
        p, sent = self.parameters, arrival.transmission
        draws = RandomDraws(p.seed, sent.transmitter, sent.number, arrival.receiver)
        frame_s = sent.packet.airtime_s / max(1, len(sent.packet.frames))
        last = max((n for n, data in enumerate(sent.packet.frames, start=1) if data), default=0)
        arrivals = []
        for number, data in enumerate(sent.packet.frames, start=1):
            received, frame_outcome = data, FrameOutcome.DELIVERED
            middle_s = arrival.start_s + (number - 0.5) * frame_s
            loss = self._frame_loss(sent, arrival.receiver, arrival.snr_db, middle_s)
            if not data:
                frame_outcome = FrameOutcome.EMPTY
            elif outcome is not PacketOutcome.ARRIVED or draws.happens(loss, "lost frame", number):
                received, frame_outcome = b"", FrameOutcome.LOST
            elif number == last and draws.happens(p.tail_damage, "tail damage"):
                received = damage_tail(data, draws, number, p.tail_damage_kind, p.tail_fraction)
                frame_outcome = FrameOutcome.DELIVERED if received == data else FrameOutcome.DAMAGED
            arrivals.append(FrameArrival(number, frame_outcome, data, received))
        return tuple(arrivals)

    @staticmethod
    def _prune(modem: _ModemState, now: float) -> None:
        """Delete what ended before the start of the earliest unresolved arrival: it can no longer overlap anything."""
        earliest_s = min((a.start_s for a in modem.arrivals if not a.resolved), default=now)
        earliest_s = min(earliest_s, now)
        modem.arrivals = [a for a in modem.arrivals if not a.resolved or a.end_s > earliest_s]
        modem.transmissions = [t for t in modem.transmissions if t.ended_s > earliest_s]
