"""Reception of packets (announcement, frames, damage, and the statistics that end a packet), and carrier sense."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import (
    CarrierSenseIgnored,
    CarrierSenseRestored,
    FrameDecoded,
    FrameReceived,
    ModemEvent,
    PacketReceived,
    SentenceRejected,
)
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import Cycle, LinkStatistics, ReceivedData, TransmitMark

FSK_MINI_PACKET = 2
"""Packet type of rate 0 headers, acknowledgements, pings and mini-packets in `CACST` and `CAXST`."""

_WITHOUT_CYCLE = frozenset({FSK_MINI_PACKET, 4, 5})
"""Packet types without frames of a cycle: mini-packets and flexible data."""


@dataclass
class _Reception:
    """What has arrived of one packet. Its frames wait for the statistics, which come last.

    Attributes:
        deadline_s: End of the wait, so that a lost sentence delays a frame and does not lose it.
        cycle: The far modem's announcement, if it has arrived.
        frames: The good frames, without statistics.
        bad_frames: Number of damaged frames.
        timed_out: Whether the modem has stopped receiving; only the statistics may follow.
    """

    deadline_s: float
    cycle: Cycle | None = None
    frames: list[FrameReceived] = field(default_factory=list)
    bad_frames: int = 0
    timed_out: bool = False

    @property
    def has_frames(self) -> bool:
        """Whether a frame has arrived, good or damaged."""
        return bool(self.frames) or self.bad_frames > 0

    @property
    def announced(self) -> bool:
        """Whether a data packet was announced or has begun to arrive."""
        return self.cycle is not None or self.has_frames

    @property
    def waits_for_data(self) -> bool:
        """Whether this is the header of a rate 0 packet, whose data follows as a packet of its own."""
        return self.cycle is not None and self.cycle.rate == 0 and not self.has_frames

    def includes(self, data: ReceivedData) -> bool:
        """Return whether a frame can be of this packet: a new frame number and the same addresses."""
        if any(frame.frame_number == data.frame_number for frame in self.frames):
            return False
        first = self.frames[0] if self.frames else self.cycle
        return first is None or (first.src, first.dest) == (data.src, data.dest)

    def is_header(self, statistics: LinkStatistics) -> bool:
        """Return whether statistics are those of a rate 0 header, with the data still to come."""
        return self.waits_for_data and (statistics.packet_type in {None, FSK_MINI_PACKET} or not statistics.nframes)

    def packet(self, statistics: LinkStatistics | None, *, ended: bool) -> PacketReceived:
        """Return the packet.

        Args:
            statistics: Statistics of the packet, or None.
            ended: Whether the modem has reported the end of the packet.
        """
        rate = nframes = None
        if self.cycle is not None:
            rate, nframes = self.cycle.rate, self.cycle.nframes
        bad_frames = self.bad_frames
        good = True
        if statistics is not None:
            rate = statistics.rate if self.cycle is None else rate
            nframes = nframes or statistics.nframes
            bad_frames = max(bad_frames, statistics.nbad or 0)
            good = statistics.good
        frames = tuple(replace(frame, statistics=statistics, rate=rate) for frame in self.frames)
        nframes = nframes or None
        sources = (*self.frames[:1], self.cycle, statistics)
        src, dest = next(((source.src, source.dest) for source in sources if source is not None), (None, None))
        complete = ended and good and bad_frames == 0 and nframes is not None and len(frames) >= nframes
        return PacketReceived(frames, bad_frames, nframes, src, dest, rate, statistics, complete)


class ReceptionTracker:
    """Follows receptions."""

    def __init__(self, config: MicroModemConfig) -> None:
        self._config = config
        self.reception: _Reception | None = None

    @property
    def receiving(self) -> bool:
        """Whether a packet is being received, as far as known."""
        return self.reception is not None and not self.reception.timed_out

    @property
    def deadline_s(self) -> float | None:
        """When the reception is closed without its statistics."""
        return None if self.reception is None else self.reception.deadline_s

    def on_start(self, now: float) -> list[ModemEvent]:
        """Process `CARXP`: a packet begins to arrive."""
        if self.reception is not None and self.reception.waits_for_data:
            self._restart(self.reception, now)
            return []
        events = self.flush()
        self._open(now)
        return events

    def on_cycle(self, cycle: Cycle, now: float) -> list[ModemEvent]:
        """Process `CACYC` of another modem: the announcement of a packet."""
        events: list[ModemEvent] = []
        if self.reception is not None and self.reception.announced:
            events = self.flush()
        reception = self._open(now)
        reception.cycle = cycle
        self._restart(reception, now)
        return events

    def on_frame(self, data: ReceivedData, now: float) -> list[ModemEvent]:
        """Process a good frame, even if the sentences before it were lost."""
        events: list[ModemEvent] = []
        if self.reception is not None and not self.reception.includes(data):
            events = self.flush()
        reception = self._open(now)
        rate = None if reception.cycle is None else reception.cycle.rate
        frame = FrameReceived(data.src, data.dest, data.ack, data.frame_number, data.data, now, rate, None)
        reception.frames.append(frame)
        self._extend(reception, now)
        return [*events, FrameDecoded(frame)]

    def on_message(self, text: str, now: float) -> None:
        """Process `CAMSG`: a damaged frame, a time-out, or another message."""
        if text == "BAD_CRC":
            reception = self._open(now)
            reception.bad_frames += 1
            self._extend(reception, now)
        elif text == "PACKET_TIMEOUT" and self.reception is not None:
            self.reception.timed_out = True
            self.reception.deadline_s = now + self._config.statistics_timeout_s

    def on_acknowledgement(self, now: float) -> None:
        """Process `CAACK`: the packet carries acknowledgements."""
        if self.reception is not None:
            self._extend(self.reception, now)

    def on_statistics(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """Process `CACST`, which ends a packet even if it is invalid."""
        try:
            statistics = LinkStatistics.parse(sentence)
        except SentenceError as error:
            return [*self._close(None, ended=True), SentenceRejected(error)]
        if self.reception is None:
            return []
        if self.reception.is_header(statistics):
            self._restart(self.reception, now)
            return []
        damaged_data = bool(statistics.nbad) and statistics.packet_type not in _WITHOUT_CYCLE
        if not self.reception.announced and not damaged_data:
            self.reception = None
            return []
        return self._close(statistics, ended=True)

    def poll(self, now: float) -> list[ModemEvent]:
        """Close a reception whose end was lost."""
        if self.reception is None or now < self.reception.deadline_s:
            return []
        return self.flush()

    def flush(self) -> list[ModemEvent]:
        """Close the reception and return what has arrived of its packet."""
        return self._close(None, ended=False)

    def _open(self, now: float) -> _Reception:
        if self.reception is None:
            self.reception = _Reception(now)
            self._restart(self.reception, now)
        return self.reception

    def _restart(self, reception: _Reception, now: float) -> None:
        """Restart the time limit: the packet, or the data after a header, begins to arrive."""
        reception.timed_out = False
        reception.deadline_s = now + self._config.on_air_limit_s(reception.cycle.rate if reception.cycle else None)

    def _extend(self, reception: _Reception, now: float) -> None:
        """Extend the time limit: the modem reports frames while later ones are still on the air."""
        reception.timed_out = False
        reception.deadline_s = max(reception.deadline_s, now + self._config.statistics_timeout_s)

    def _close(self, statistics: LinkStatistics | None, *, ended: bool) -> list[ModemEvent]:
        reception, self.reception = self.reception, None
        if reception is None or (statistics is None and not reception.announced):
            return []
        packet = reception.packet(statistics, ended=ended)
        return [*packet.frames, packet]


class CarrierSense:
    """Follows how long the channel has been busy without a pause.

    The channel is busy during a reception, and during a transmission that this driver did not start. A modem that
    reports receptions without an end must not stop the driver: after `max_carrier_sense_s` without a pause the driver
    transmits. It defers again after the next pause.
    """

    def __init__(self, config: MicroModemConfig) -> None:
        self._config = config
        self._transmitting_until_s: float | None = None
        self._busy_since_s: float | None = None
        self._ignored = False

    @property
    def channel_free(self) -> bool:
        """Whether the driver may start a transmission."""
        return self._busy_since_s is None or self._ignored

    @property
    def deadline_s(self) -> float | None:
        """When `update` has something to do, or None."""
        limit_s = None
        if self._busy_since_s is not None and not self._ignored:
            limit_s = self._busy_since_s + self._config.max_carrier_sense_s
        return min((time_s for time_s in (self._transmitting_until_s, limit_s) if time_s is not None), default=None)

    def on_transmission(self, mark: TransmitMark, now: float) -> None:
        """Process the start or the end of a transmission that this driver did not start."""
        self._transmitting_until_s = None if mark.ends else now + self._config.on_air_limit_s(None)

    def update(self, now: float, *, receiving: bool) -> list[ModemEvent]:
        """Compare the state of the channel with the limit; call after every change and at `deadline_s`.

        Args:
            now: Time on the driver's clock.
            receiving: Whether a packet is being received.
        """
        if self._transmitting_until_s is not None and now >= self._transmitting_until_s:
            self._transmitting_until_s = None
        if not receiving and self._transmitting_until_s is None:
            return self.reset(now)
        if self._busy_since_s is None:
            self._busy_since_s = now
        # Compared as in `deadline_s`, so that the call at that time has an effect.
        if self._ignored or now < self._busy_since_s + self._config.max_carrier_sense_s:
            return []
        self._ignored = True
        return [CarrierSenseIgnored(now - self._busy_since_s)]

    def reset(self, now: float) -> list[ModemEvent]:
        """Record that the channel is free."""
        since_s, was_ignored = self._busy_since_s, self._ignored
        self._transmitting_until_s = self._busy_since_s = None
        self._ignored = False
        return [CarrierSenseRestored(now - since_s)] if since_s is not None and was_ignored else []
