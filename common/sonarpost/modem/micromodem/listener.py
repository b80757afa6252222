"""The receiving side: opens and closes receptions, and says what arrived."""

from __future__ import annotations

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.config import MicroModemConfig
from sonarpost.modem.micromodem.events import (
    FrameDecoded,
    ModemEvent,
    ModemMessageReceived,
    SentenceRejected,
    StatisticsReceived,
)
from sonarpost.modem.micromodem.nmea import Sentence
from sonarpost.modem.micromodem.receive import PacketReception
from sonarpost.modem.micromodem.sentences import Cycle, ModemMessage, ReceivedData
from sonarpost.modem.micromodem.statistics import LinkStatistics

_NO_CYCLE = frozenset({2, 4, 5})
"""Packet types that carry no frames of a cycle: mini-packets and flexible data."""


class ReceptionTracker:
    """Follows packets on their way in. The water is busy while `reception` is not None."""

    def __init__(self, config: MicroModemConfig) -> None:
        self._config = config
        self.reception: PacketReception | None = None

    @property
    def deadline_s(self) -> float | None:
        """When the present reception is closed without its statistics."""
        return None if self.reception is None else self.reception.deadline_s

    def on_start(self, now: float) -> list[ModemEvent]:
        """Something begins to arrive; what came before it is over."""
        if self.reception is not None and self.reception.waits_for_data:
            self.reception.on_start(now)
            return []
        events = self.flush()
        self.reception = PacketReception(self._config, now)
        return events

    def on_cycle(self, cycle: Cycle, now: float) -> list[ModemEvent]:
        """A far modem announces a packet."""
        events: list[ModemEvent] = []
        if self.reception is not None and self.reception.announced:
            events = self.flush()
        self._open(now).on_cycle(cycle, now)
        return events

    def on_frame(self, data: ReceivedData, now: float) -> list[ModemEvent]:
        """A good frame, even where the sentences that should come before it were lost."""
        events: list[ModemEvent] = []
        if self.reception is not None and not self.reception.belongs(data):
            events = self.flush()
        frame = self._open(now).on_frame(data, now)
        return [*events, FrameDecoded(frame)]

    def on_message(self, message: ModemMessage, now: float) -> list[ModemEvent]:
        """A damaged frame, the end of waiting, or something else the modem says."""
        if message.text == "BAD_CRC":
            self._open(now).on_bad_frame(now)
            return []
        if message.text == "PACKET_TIMEOUT" and self.reception is not None:
            self.reception.on_timeout(now)
        return [ModemMessageReceived(message)]

    def on_acknowledgement(self, now: float) -> None:
        """The packet that arrives carries acknowledgements."""
        if self.reception is not None:
            self.reception.on_acknowledgement(now)

    def on_statistics(self, sentence: Sentence, now: float) -> list[ModemEvent]:
        """The statistics, which end a packet even where nobody can read them."""
        try:
            statistics = LinkStatistics.parse(sentence)
        except SentenceError as error:
            return [*self._close(None, over=True), SentenceRejected(error)]
        if self.reception is None:
            return [StatisticsReceived(statistics)]
        if self.reception.is_announcement(statistics):
            self.reception.on_start(now)
            return [StatisticsReceived(statistics)]
        if not self.reception.announced and not _damaged_data(statistics):
            self.reception = None
            return [StatisticsReceived(statistics)]
        return self._close(statistics, over=True)

    def poll(self, now: float) -> list[ModemEvent]:
        """Close a reception whose end was lost."""
        if self.reception is None or now < self.reception.deadline_s:
            return []
        return self.flush()

    def flush(self) -> list[ModemEvent]:
        """Hand over what has arrived of an unfinished packet."""
        return self._close(None, over=False)

    def _open(self, now: float) -> PacketReception:
        if self.reception is None:
            self.reception = PacketReception(self._config, now)
        return self.reception

    def _close(self, statistics: LinkStatistics | None, *, over: bool) -> list[ModemEvent]:
        reception, self.reception = self.reception, None
        if reception is None or (statistics is None and not reception.announced):
            return []
        frames, packet = reception.close(statistics, over=over)
        return [*frames, packet]


def _damaged_data(statistics: LinkStatistics) -> bool:
    """Tell whether statistics alone show a data packet of which nothing was readable."""
    return bool(statistics.nbad) and statistics.packet_type not in _NO_CYCLE
