"""Masking of the pings that were recorded during a transmission of the vehicle's own modem.

The modem is louder than any echo, and a burst of it in a few pings resembles highlights with shadows. A masked ping has
no channels: its echo is unknown, as in a ping that the recorder lost. The seabed statistics ignore it, no contact has
its centre there, and its edges are those of the recording, not of an object.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final, Self

from typing_extensions import override

from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Ping

MARGIN_BEFORE_S: Final = 0.2
"""Default tolerance before a transmission: the modem reports its start over a serial line."""
MARGIN_AFTER_S: Final = 0.5
"""Default tolerance after a transmission, for its reverberation."""
WARNING_SHARE: Final = 0.5
"""A file of which a greater share is masked deserves a warning."""
_SOUND_SPEED_MPS: Final = 1500.0


@dataclass(frozen=True, slots=True)
class TransmitIntervals:
    """Times in which the own modem transmits, with their margins; disjoint and in ascending order.

    Attributes:
        starts_utc_s: Start of each, seconds since 1970-01-01 UTC.
        ends_utc_s: End of each.
    """

    starts_utc_s: tuple[float, ...] = ()
    ends_utc_s: tuple[float, ...] = ()

    @classmethod
    def of(
        cls,
        intervals: Iterable[tuple[float, float]],
        before_s: float = MARGIN_BEFORE_S,
        after_s: float = MARGIN_AFTER_S,
    ) -> Self:
        """Return intervals in any order, overlapping or not, extended by margins.

        Args:
            intervals: Start and end of each transmission, seconds since 1970-01-01 UTC.
            before_s: Time before each start that counts as transmission, 0 or more.
            after_s: Time after each end that counts as transmission, 0 or more.

        Raises:
            ValueError: A value is not finite, a margin is negative, or an end is before its start.
        """
        if not (0 <= before_s < math.inf and 0 <= after_s < math.inf):
            raise ValueError(f"margins: got {before_s}, {after_s}, expected 0 s or more")
        starts: list[float] = []
        ends: list[float] = []
        for start_s, end_s in sorted(intervals):
            if not (math.isfinite(start_s) and math.isfinite(end_s) and start_s <= end_s):
                raise ValueError(f"transmission: got {start_s} to {end_s}, expected a start and an end at or after it")
            if ends and start_s - before_s <= ends[-1]:
                ends[-1] = max(ends[-1], end_s + after_s)
            else:
                starts.append(start_s - before_s)
                ends.append(end_s + after_s)
        return cls(tuple(starts), tuple(ends))

    def contains(self, ping: Ping) -> bool:
        """Return whether a ping was transmitted, or its echo was received, during a transmission."""
        range_m = max((channel.slant_range_m for channel in ping.channels), default=0.0)
        listened_s = 2.0 * range_m / _SOUND_SPEED_MPS
        last = bisect_right(self.starts_utc_s, ping.time_utc_s + listened_s) - 1
        return last >= 0 and self.ends_utc_s[last] >= ping.time_utc_s


class MaskedSource(SurveySource):
    """An open recording whose disturbed pings have no channels, with their navigation.

    Args:
        source: The recording; its owner closes it.
        intervals: Transmissions of the own modem.

    Attributes:
        masked_count: Pings that the latest iteration has masked.
        newest: Latest ping with a position; None before the first.
    """

    def __init__(self, source: SurveySource, intervals: TransmitIntervals) -> None:
        self.info = source.info
        self.options = source.options
        self.masked_count = 0
        self.newest: Ping | None = None
        self._source = source
        self._intervals = intervals

    @override
    def pings(self) -> Iterator[Ping]:
        self.masked_count = 0
        for ping in self._source.pings():
            is_masked = self._intervals.contains(ping)
            self.masked_count += is_masked
            if ping.lat_deg is not None and ping.lon_deg is not None:
                self.newest = ping
            yield replace(ping, channels=()) if is_masked else ping

    @property
    def masked_share(self) -> float:
        """Share of the file's pings that the latest iteration has masked, 0 to 1."""
        return self.masked_count / self.info.ping_count
