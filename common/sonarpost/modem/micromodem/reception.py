"""Reception of packets: announcement, frames, damage, and the statistics that end a packet."""

from __future__ import annotations

from dataclasses import replace

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import (
    FrameDecoded,
    FrameReceived,
    ModemEvent,
    ModemMessageReceived,
    PacketReceived,
    SentenceRejected,
    StatisticsReceived,
)
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.sentences import Cycle, ModemMessage, ReceivedData
from sonarpost.modem.micromodem.statistics import LinkStatistics

FSK_MINI_PACKET = 2
"""Packet type of rate 0 headers, acknowledgements, pings and mini-packets in `CACST` and `CAXST`."""

_WITHOUT_CYCLE = frozenset({FSK_MINI_PACKET, 4, 5})
"""Packet types without frames of a cycle: mini-packets and flexible data."""


class PacketReception:
    """Collects the sentences about one packet until `close`.

    Frames wait for the statistics, which come last. `deadline_s` ends the wait, so that a lost sentence delays a frame
    and does not lose it.
    """

    def __init__(self, config: MicroModemConfig, now: float) -> None:
        self._config = config
        self._cycle: Cycle | None = None
        self._frames: list[FrameReceived] = []
        self._bad_frames = 0
        self.on_start(now)

    @property
    def announced(self) -> bool:
        """Whether a data packet was announced or has begun to arrive."""
        return self._cycle is not None or self._has_frames

    @property
    def waits_for_data(self) -> bool:
        """Whether this is the header of a rate 0 packet, whose data follows as a packet of its own."""
        return self._cycle is not None and self._cycle.rate == 0 and not self._has_frames

    @property
    def _has_frames(self) -> bool:
        return bool(self._frames) or self._bad_frames > 0

    def on_start(self, now: float) -> None:
        """Restart the time limit: the packet, or the data after a header, begins to arrive."""
        rate = None if self._cycle is None else self._cycle.rate
        self.deadline_s = now + self._config.on_air_limit_s(rate)

    def on_cycle(self, cycle: Cycle, now: float) -> None:
        """Store the far modem's announcement."""
        self._cycle = cycle
        self.on_start(now)

    def includes(self, data: ReceivedData) -> bool:
        """Return whether a frame can be of this packet: a new frame number and the same addresses."""
        if any(frame.frame_number == data.frame_number for frame in self._frames):
            return False
        first = self._frames[0] if self._frames else self._cycle
        return first is None or (first.src, first.dest) == (data.src, data.dest)

    def on_frame(self, data: ReceivedData, now: float) -> FrameReceived:
        """Store a good frame and return it, without statistics."""
        rate = None if self._cycle is None else self._cycle.rate
        frame = FrameReceived(data.src, data.dest, data.ack, data.frame_number, data.data, now, rate, None)
        self._frames.append(frame)
        self.extend(now)
        return frame

    def on_bad_frame(self, now: float) -> None:
        """Count a damaged frame."""
        self._bad_frames += 1
        self.extend(now)

    def extend(self, now: float) -> None:
        """Extend the time limit: the modem reports frames while later ones are still on the air."""
        self.deadline_s = max(self.deadline_s, now + self._config.statistics_timeout_s)

    def on_timeout(self, now: float) -> None:
        """Wait only for the statistics: the modem has stopped waiting for the rest of the packet."""
        self.deadline_s = now + self._config.statistics_timeout_s

    def is_header(self, statistics: LinkStatistics) -> bool:
        """Return whether statistics are those of a rate 0 header, with the data still to come."""
        return self.waits_for_data and (statistics.packet_type in {None, FSK_MINI_PACKET} or not statistics.nframes)

    def close(self, statistics: LinkStatistics | None, *, ended: bool) -> PacketReceived:
        """Return the packet.

        Args:
            statistics: Statistics of the packet, or None.
            ended: Whether the modem has reported the end of the packet.
        """
        rate = nframes = None
        if self._cycle is not None:
            rate, nframes = self._cycle.rate, self._cycle.nframes
        bad_frames = self._bad_frames
        good = True
        if statistics is not None:
            rate = statistics.rate if self._cycle is None else rate
            nframes = nframes or statistics.nframes
            bad_frames = max(bad_frames, statistics.nbad or 0)
            good = statistics.good
        frames = tuple(replace(frame, statistics=statistics, rate=rate) for frame in self._frames)
        nframes = nframes or None
        sources = (*self._frames[:1], self._cycle, statistics)
        src, dest = next(((source.src, source.dest) for source in sources if source is not None), (None, None))
        complete = ended and good and bad_frames == 0 and nframes is not None and len(frames) >= nframes
        return PacketReceived(frames, bad_frames, nframes, src, dest, rate, statistics, complete)


class ReceptionTracker:
    """Follows receptions. The channel is busy while `reception` is not None."""

    def __init__(self, config: MicroModemConfig) -> None:
        self._config = config
        self.reception: PacketReception | None = None

    @property
    def deadline_s(self) -> float | None:
        """When the reception is closed without its statistics."""
        return None if self.reception is None else self.reception.deadline_s

    def on_start(self, now: float) -> list[ModemEvent]:
        """Process `CARXP`: a packet begins to arrive."""
        if self.reception is not None and self.reception.waits_for_data:
            self.reception.on_start(now)
            return []
        events = self.flush()
        self._open(now)
        return events

    def on_cycle(self, cycle: Cycle, now: float) -> list[ModemEvent]:
        """Process `CACYC` of another modem: the announcement of a packet."""
        events: list[ModemEvent] = []
        if self.reception is not None and self.reception.announced:
            events = self.flush()
        self._open(now).on_cycle(cycle, now)
        return events

    def on_frame(self, data: ReceivedData, now: float) -> list[ModemEvent]:
        """Process a good frame, even if the sentences before it were lost."""
        events: list[ModemEvent] = []
        if self.reception is not None and not self.reception.includes(data):
            events = self.flush()
        frame = self._open(now).on_frame(data, now)
        return [*events, FrameDecoded(frame)]

    def on_message(self, message: ModemMessage, now: float) -> list[ModemEvent]:
        """Process `CAMSG`: a damaged frame, a time-out, or another message."""
        if message.text == "BAD_CRC":
            self._open(now).on_bad_frame(now)
            return []
        if message.text == "PACKET_TIMEOUT" and self.reception is not None:
            self.reception.on_timeout(now)
        return [ModemMessageReceived(message)]

    def on_acknowledgement(self, now: float) -> None:
        """Process `CAACK`: the packet carries acknowledgements."""
        if self.reception is not None:
            self.reception.extend(now)

    def on_statistics(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """Process `CACST`, which ends a packet even if it is invalid."""
        try:
            statistics = LinkStatistics.parse(sentence)
        except SentenceError as error:
            return [*self._close(None, ended=True), SentenceRejected(error)]
        if self.reception is None:
            return [StatisticsReceived(statistics)]
        if self.reception.is_header(statistics):
            self.reception.on_start(now)
            return [StatisticsReceived(statistics)]
        damaged_data = bool(statistics.nbad) and statistics.packet_type not in _WITHOUT_CYCLE
        if not self.reception.announced and not damaged_data:
            self.reception = None
            return [StatisticsReceived(statistics)]
        return self._close(statistics, ended=True)

    def poll(self, now: float) -> list[ModemEvent]:
        """Close a reception whose end was lost."""
        if self.reception is None or now < self.reception.deadline_s:
            return []
        return self.flush()

    def flush(self) -> list[ModemEvent]:
        """Close the reception and return what has arrived of its packet."""
        return self._close(None, ended=False)

    def _open(self, now: float) -> PacketReception:
        if self.reception is None:
            self.reception = PacketReception(self._config, now)
        return self.reception

    def _close(self, statistics: LinkStatistics | None, *, ended: bool) -> list[ModemEvent]:
        reception, self.reception = self.reception, None
        if reception is None or (statistics is None and not reception.announced):
            return []
        packet = reception.close(statistics, ended=ended)
        return [*packet.frames, packet]
