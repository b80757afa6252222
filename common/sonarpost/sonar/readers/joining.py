"""Joins the parts of pings: a recorder may write a side, a frequency or a transducer in records of its own."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from sonarpost.sonar.survey import ChannelPing

_HELD: Final = 32
"""Number of pings that wait for further parts: longer than the batches in which recorders write."""

HeadT = TypeVar("HeadT")


@dataclass(slots=True)
class PingPart(Generic[HeadT]):
    """Channels of a ping from one record, or the whole ping.

    Attributes:
        number: Number of the ping in the file.
        time_utc_s: Time of transmission, or any clock in seconds that the parts of a ping share.
        head: Further values of the reader; those of the first part remain.
        channels: At least one, no two of the same side, frequency and index.
    """

    number: int
    time_utc_s: float
    head: HeadT
    channels: tuple[ChannelPing, ...]


def joined(
    parts: Iterable[PingPart[HeadT]],
    *,
    max_gap_s: float,
    by_number: bool = True,
    held_pings: int = _HELD,
    reorder_s: float = 0.0,
) -> Iterator[PingPart[HeadT]]:
    """Yield whole pings, in the order of their first parts.

    Parts are of the same ping if they have the same number and their times differ by at most `max_gap_s`, and if none
    of their channels is of the same side, frequency and index.

    Args:
        parts: Parts in the order of the file.
        max_gap_s: Less than the interval of the pings.
        by_number: False if the numbers of the parts of a ping differ.
        held_pings: Number of pings that wait for further parts.
        reorder_s: Pings that are early by at most this time are moved forward, to the order of their times.
    """
    held: list[PingPart[HeadT]] = []
    for part in parts:
        own = _channels_of(part)
        candidates = (
            ping
            for ping in reversed(held)  # of equally near ones the last: a copied span repeats whole pings
            if (ping.number == part.number or not by_number)
            and abs(ping.time_utc_s - part.time_utc_s) <= max_gap_s
            and own.isdisjoint(_channels_of(ping))
        )
        ping = min(candidates, key=lambda ping: abs(ping.time_utc_s - part.time_utc_s), default=None)
        if ping is not None:
            ping.channels += part.channels
            continue
        place = len(held)
        while place and 0 < held[place - 1].time_utc_s - part.time_utc_s <= reorder_s:
            place -= 1
        held.insert(place, part)
        if len(held) > held_pings:
            yield held.pop(0)
    yield from held


def _channels_of(part: PingPart[HeadT]) -> set[tuple[object, ...]]:
    return {(channel.side, channel.frequency_hz, channel.index) for channel in part.channels}
