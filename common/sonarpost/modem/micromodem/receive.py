"""One packet on its way in: its announcement, its frames, its damage, and the statistics that end it."""

from __future__ import annotations

from dataclasses import replace

from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import FrameReceived, PacketReceived
from sonarpost.modem.micromodem.sentences import Cycle, ReceivedData
from sonarpost.modem.micromodem.statistics import LinkStatistics

_FSK_MINI_PACKET = 2


class PacketReception:
    """Collects what the modem says of one packet until `close`.

    Frames wait for the statistics, which come last; `deadline_s` is when the wait is over, so that a frame is
    late at most and never lost.
    """

    def __init__(self, config: MicroModemConfig, now: float) -> None:
        self._config = config
        self._started_s = now
        self._cycle: Cycle | None = None
        self._frames: list[FrameReceived] = []
        self._bad_frames = 0
        self._limit()

    @property
    def announced(self) -> bool:
        """Whether a data packet was announced or has begun to arrive."""
        return self._cycle is not None or bool(self._frames) or self._bad_frames > 0

    @property
    def has_content(self) -> bool:
        """Whether frames, good or bad, have arrived."""
        return bool(self._frames) or self._bad_frames > 0

    @property
    def waits_for_data(self) -> bool:
        """Whether this is the announcement of a rate-0 packet, after which the data comes as a packet of its own."""
        return self._cycle is not None and self._cycle.rate == 0 and not self.has_content

    def on_start(self, now: float) -> None:
        """The data of an announced packet begins to arrive."""
        self._started_s = now
        self._limit()

    def on_cycle(self, cycle: Cycle, now: float) -> None:
        """The far modem has announced its packet."""
        self._cycle = cycle
        self._started_s = now
        self._limit()

    def belongs(self, data: ReceivedData) -> bool:
        """Tell whether a frame can be of this packet: a number seen before, or another sender, is the next one's."""
        if any(frame.frame_number == data.frame_number for frame in self._frames):
            return False
        first = self._frames[0] if self._frames else self._cycle
        return first is None or (first.src, first.dest) == (data.src, data.dest)

    def on_frame(self, data: ReceivedData, now: float) -> FrameReceived:
        """A good frame; return it as it is known so far."""
        rate = None if self._cycle is None else self._cycle.rate
        frame = FrameReceived(data.src, data.dest, data.ack, data.frame_number, data.data, now, rate, None)
        self._frames.append(frame)
        self._extend(now)
        return frame

    def on_bad_frame(self, now: float) -> None:
        """A damaged frame."""
        self._bad_frames += 1
        self._extend(now)

    def on_acknowledgement(self, now: float) -> None:
        """This packet carries acknowledgements."""
        self._extend(now)

    def on_timeout(self, now: float) -> None:
        """The modem has stopped waiting for the rest; only its statistics can still come."""
        self.deadline_s = now + self._config.statistics_timeout_s

    def is_announcement(self, statistics: LinkStatistics) -> bool:
        """Tell whether statistics are of a rate-0 packet's announcement only, with the data still to come."""
        return self.waits_for_data and (statistics.packet_type in {None, _FSK_MINI_PACKET} or not statistics.nframes)

    def close(self, statistics: LinkStatistics | None, *, over: bool) -> tuple[list[FrameReceived], PacketReceived]:
        """Return what arrived.

        Args:
            statistics: Of the packet, or None.
            over: Whether the modem has said that the packet is over.
        """
        rate = self._rate(statistics)
        frames = [replace(frame, statistics=statistics, rate=rate) for frame in self._frames]
        bad_frames = max(self._bad_frames, (statistics.nbad or 0) if statistics else 0)
        nframes = self._nframes(statistics)
        src, dest = self._addresses(statistics)
        undamaged = bad_frames == 0 and (statistics is None or statistics.good)
        complete = over and undamaged and nframes is not None and len(frames) >= nframes
        packet = PacketReceived(tuple(frames), bad_frames, nframes, src, dest, rate, statistics, complete)
        return frames, packet

    def _rate(self, statistics: LinkStatistics | None) -> int | None:
        if self._cycle is not None:
            return self._cycle.rate
        return statistics.rate if statistics is not None else None

    def _nframes(self, statistics: LinkStatistics | None) -> int | None:
        announced = self._cycle.nframes if self._cycle is not None else 0
        counted = (statistics.nframes or 0) if statistics is not None else 0
        return announced or counted or None

    def _addresses(self, statistics: LinkStatistics | None) -> tuple[int | None, int | None]:
        for source in (*self._frames[:1], self._cycle, statistics):
            if source is not None:
                return source.src, source.dest
        return None, None

    def _limit(self) -> None:
        rate = None if self._cycle is None else self._cycle.rate
        self.deadline_s = self._started_s + self._config.on_air_limit_s(rate)

    def _extend(self, now: float) -> None:
        # Frames are handed over while later ones may still be on the air.
        self.deadline_s = max(self.deadline_s, now + self._config.statistics_timeout_s)
