"""The water between the modems: travel time, half duplex, collisions, loss and damage.

Pure: packets and `now` in, events out. The rules, all of them:

- A packet occupies its whole air time, however full its frames are, and reaches every other modem after
  range / sound speed. Positions count at the moment of transmission.
- Half duplex: whatever overlaps a modem's own transmission is not heard by it, not even in part.
- Packets whose arrivals overlap at a receiver destroy each other there, whatever their strengths (no capture effect)
  and whether or not they were meant for it; one packet may collide at one modem and arrive whole at another.
  Arrivals that only touch do not overlap.
- A packet may be lost whole (nothing is detected), each non-empty frame may be lost on its own (a bad CRC is
  noticed), and the tail of the last non-empty frame may be damaged and still pass for good.
- With `range_loss`, the frame error rate that belongs to the rate and the signal-to-noise ratio is added, and below
  `DETECTION_SNR_DB` nothing is detected.
- With burst fading, each frame counts at the time of its middle, and a packet is detected by its beginning.
- Draws depend on (seed, transmitter, its packet number, receiver, frame) alone, fades on (seed, path, time), so a run
  can be repeated.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass, field

from sonarpost.simulation.channel.acoustics import LocalPosition, frame_error_rate, transmission_loss_db
from sonarpost.simulation.channel.channel_config import ChannelParameters
from sonarpost.simulation.channel.channel_events import (
    AcousticPacket,
    ArrivalEnded,
    ArrivalStarted,
    FrameArrival,
    FrameOutcome,
    PacketOutcome,
    Transmission,
)
from sonarpost.simulation.channel.fading import Fading
from sonarpost.simulation.channel.random_draws import RandomDraws, damage_tail

DETECTION_SNR_DB = -12.0
"""With `range_loss`, packets weaker than this are not noticed at all."""


@dataclass(slots=True)
class _PendingArrival:
    """A transmission at one receiver, `start_s` to `end_s`."""

    receiver: int
    transmission: Transmission
    start_s: float
    end_s: float
    range_m: float
    snr_db: float
    lost: bool
    detected: bool = False
    resolved: bool = False


@dataclass(slots=True)
class _Place:
    """What the water remembers about one modem."""

    position: LocalPosition
    sent: int = 0
    transmissions: list[Transmission] = field(default_factory=list)
    arrivals: list[_PendingArrival] = field(default_factory=list)


class ChannelModel:
    """The shared medium of any number of modems.

    Args:
        config: What the water does.
        positions: Where each modem is, by its number.
    """

    def __init__(self, config: ChannelParameters, positions: Mapping[int, LocalPosition]) -> None:
        self.config = config
        self._places = {modem: _Place(position) for modem, position in positions.items()}
        # (time, 0 for an end and 1 for a start, order, arrival): ends come first, since touching is not overlapping
        self._events: list[tuple[float, int, int, _PendingArrival]] = []
        self._order = 0
        self._fading = Fading(config.seed, config.mean_clear_s, config.mean_fade_s)
        self._reference_snr_db = config.reference_snr_db
        self._absorption_db_per_km = config.absorption_db_per_km

    @property
    def in_flight(self) -> int:
        """How many arrivals are still to end."""
        return sum(not arrival.resolved for place in self._places.values() for arrival in place.arrivals)

    def move(self, modem: int, position: LocalPosition) -> None:
        """Put a modem elsewhere; packets already on their way keep their travel time."""
        self._places[modem].position = position

    def travel_times_s(self, modem: int, places: Mapping[str, LocalPosition]) -> dict[str, float]:
        """Return how long sound takes, in seconds, from a modem to places that are no modems, by their names."""
        here = self._places[modem].position
        return {name: here.range_m(place) / self.config.sound_speed_m_per_s for name, place in places.items()}

    def next_event_s(self) -> float | None:
        """Return the simulated time of the next event, or None while the water is quiet."""
        return self._events[0][0] if self._events else None

    def transmit(self, modem: int, packet: AcousticPacket, now: float) -> Transmission:
        """Put a packet into the water at `now`.

        Raises:
            ValueError: The modem is still transmitting, or `airtime_s` is not above zero.
        """
        place = self._places[modem]
        self._forget(place, now)
        if packet.airtime_s <= 0:
            raise ValueError(f"airtime_s: got {packet.airtime_s!r}, expected above 0")
        if any(now < sent.ended_s for sent in place.transmissions):
            raise ValueError(f"modem {modem} transmits until {place.transmissions[-1].ended_s}, not again at {now}")
        place.sent += 1
        sent = Transmission(modem, place.sent, packet, now, now + packet.airtime_s)
        place.transmissions.append(sent)
        for receiver, other in self._places.items():
            if receiver != modem:
                self._send_towards(receiver, other, sent, place.position)
        return sent

    def poll(self, now: float) -> list[ArrivalStarted | ArrivalEnded]:
        """Return what happened up to and including `now`, in order of time."""
        happened: list[ArrivalStarted | ArrivalEnded] = []
        while self._events and self._events[0][0] <= now:
            at_s, is_start, _, arrival = heapq.heappop(self._events)
            if is_start:
                if self._detect(arrival, at_s):
                    happened.append(ArrivalStarted(arrival.receiver, at_s, arrival.transmission))
            else:
                happened.append(self._resolve(arrival, at_s))
        return happened

    def _send_towards(self, receiver: int, place: _Place, sent: Transmission, origin: LocalPosition) -> None:
        range_m = origin.range_m(place.position)
        start_s = sent.started_s + range_m / self.config.sound_speed_m_per_s
        dice = RandomDraws(self.config.seed, sent.transmitter, sent.number, receiver)
        level_db = self.snr_db(range_m) + self.config.snr_spread_db * (2 * dice.uniform("snr") - 1)
        detectable_db = level_db - self._fade_db(sent.transmitter, receiver, start_s)
        lost = dice.happens(self.config.packet_loss, "packet loss") or (
            self.config.range_loss and detectable_db < DETECTION_SNR_DB
        )
        if not sent.packet.frames:  # an acknowledgement or mini-packet is lost like a frame, and then not noticed
            lost = lost or dice.happens(self._frame_loss(sent, receiver, level_db, start_s), "lost frame")
        end_s = start_s + sent.packet.airtime_s
        arrival = _PendingArrival(receiver, sent, start_s, end_s, range_m, level_db, lost)
        place.arrivals.append(arrival)
        for at_s, is_start in ((start_s, 1), (end_s, 0)):
            self._order += 1
            heapq.heappush(self._events, (at_s, is_start, self._order, arrival))

    def snr_db(self, range_m: float) -> float:
        """Return the mean signal-to-noise ratio at a range, dB."""
        loss_db = transmission_loss_db(range_m, self._absorption_db_per_km, self.config.spreading_db_per_decade)
        return self._reference_snr_db - loss_db

    def _fade_db(self, transmitter: int, receiver: int, at_s: float) -> float:
        return self.config.fade_depth_db if self._fading.faded(transmitter, receiver, at_s) else 0.0

    def _frame_loss(self, sent: Transmission, receiver: int, level_db: float, at_s: float) -> float:
        """Return the chance that what arrives at `at_s` is lost, whatever of the three causes it is."""
        faded = self._fading.faded(sent.transmitter, receiver, at_s)
        level_db -= self.config.fade_depth_db if faded else 0.0
        by_range = frame_error_rate(sent.packet.rate, level_db) if self.config.range_loss else 0.0
        by_fade = self.config.fade_loss if faded else 0.0
        return 1.0 - (1.0 - self.config.frame_loss) * (1.0 - by_range) * (1.0 - by_fade)

    def _detect(self, arrival: _PendingArrival, at_s: float) -> bool:
        place = self._places[arrival.receiver]
        transmitting = any(sent.started_s <= at_s < sent.ended_s for sent in place.transmissions)
        busy = any(other.detected and not other.resolved for other in place.arrivals)
        arrival.detected = not (arrival.lost or transmitting or busy)
        return arrival.detected

    def _resolve(self, arrival: _PendingArrival, at_s: float) -> ArrivalEnded:
        arrival.resolved = True
        outcome = self._outcome(arrival)
        self._forget(self._places[arrival.receiver], at_s)
        return ArrivalEnded(
            arrival.receiver,
            at_s,
            arrival.transmission,
            outcome,
            arrival.detected,
            self._frames(arrival, outcome),
            arrival.range_m,
            arrival.snr_db,
            arrival.start_s - arrival.transmission.started_s,
        )

    def _outcome(self, arrival: _PendingArrival) -> PacketOutcome:
        place = self._places[arrival.receiver]
        if any(sent.started_s < arrival.end_s and arrival.start_s < sent.ended_s for sent in place.transmissions):
            return PacketOutcome.TRANSMITTING
        if any(
            other is not arrival and other.start_s < arrival.end_s and arrival.start_s < other.end_s
            for other in place.arrivals
        ):
            return PacketOutcome.COLLISION
        return PacketOutcome.LOST if arrival.lost else PacketOutcome.ARRIVED

    def _frames(self, arrival: _PendingArrival, outcome: PacketOutcome) -> tuple[FrameArrival, ...]:
        sent = arrival.transmission
        dice = RandomDraws(self.config.seed, sent.transmitter, sent.number, arrival.receiver)
        frame_s = sent.packet.airtime_s / max(1, len(sent.packet.frames))
        last = max((n for n, data in enumerate(sent.packet.frames, start=1) if data), default=0)
        arrivals = []
        for number, data in enumerate(sent.packet.frames, start=1):
            received, fate = data, FrameOutcome.DELIVERED
            middle_s = arrival.start_s + (number - 0.5) * frame_s
            loss = self._frame_loss(sent, arrival.receiver, arrival.snr_db, middle_s)
            if not data:
                fate = FrameOutcome.EMPTY
            elif outcome is not PacketOutcome.ARRIVED or dice.happens(loss, "lost frame", number):
                received, fate = b"", FrameOutcome.LOST
            elif number == last and dice.happens(self.config.tail_damage, "tail damage"):
                kind, fraction = self.config.tail_damage_kind, self.config.tail_fraction
                received = damage_tail(data, dice, number, kind, fraction)
                fate = FrameOutcome.DELIVERED if received == data else FrameOutcome.DAMAGED
            arrivals.append(FrameArrival(number, fate, data, received))
        return tuple(arrivals)

    @staticmethod
    def _forget(place: _Place, now: float) -> None:
        """Drop what can no longer overlap anything: all that ended before the earliest arrival still open began."""
        earliest_s = min((a.start_s for a in place.arrivals if not a.resolved), default=now)
        earliest_s = min(earliest_s, now)
        place.arrivals = [a for a in place.arrivals if not a.resolved or a.end_s > earliest_s]
        place.transmissions = [t for t in place.transmissions if t.ended_s > earliest_s]
