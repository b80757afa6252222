"""Pings of SVLOG recordings: profiles of several transducers are joined, and their clocks converted to UTC.

Each transducer is a sonar of its own, whose clock and ping counter begin when it is switched on. The computer has
another clock, with the date of the session. A segment is a part of a recording in which clocks and counters continue:
it begins with a session, or with the restart of a sonar. Its first profiles show how counters and clocks differ.

* Profiles are of one ping if their numbers agree, once the difference of the counters is subtracted, in any order in
  the file. Without a common difference they are joined by time, within three quarters of an interval.
* A clock up to a minute after the computer's uptime is the computer's, which has the date of the session. Otherwise the
  first profile is at the date of the session, or later by the time that MAVLink messages have counted between them.
* After a restart the time continues from the last profile.
* Received times that agree with each other have priority over a date that differs from them.
* Positions are interpolated between those of the messages before and after a ping.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice, pairwise
from statistics import fmean, median
from typing import Any, Final, NamedTuple

from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.readers.joining import PingPart, joined
from sonarpost.sonar.readers.open_file import CheckedFile
from sonarpost.sonar.readers.records import Notes
from sonarpost.sonar.readers.svlog_messages import Received
from sonarpost.sonar.survey import ChannelPing, Ping, Side

_HEAD_PROFILES: Final = 256
"""Number of profiles at the start of a segment that show the differences of counters and clocks."""
_HELD_PINGS: Final = 128
"""Number of pings that wait for the other side: writers are known to be up to 63 pings behind on one side."""
_BATCH_S: Final = 20.0
"""Longer than the batches in which a writer stores the profiles of a transducer."""
_VALID_S: Final = 5.0
"""Maximum age of a navigation message."""
_MAX_SPEED_MPS: Final = 30.0
_FIRST_INTERVAL_S: Final = 1 / 3
"""Interval of the pings if a segment does not show it."""
_PAIR_INTERVALS: Final = 0.75
_SAME_NUMBER_S: Final = 2.0
"""Greatest difference of the times of profiles with the same number: the clocks of two sonars drift apart."""
_SAME_CLOCK_INTERVALS: Final = 2.0
_SAME_CLOCK_S: Final = (-1.0, 60.0)
"""Time of the first profile after the session packet, if both have the same clock."""
_RESTART_S: Final = 10.0
_CERTAIN_S: Final = 10.0
"""Up to this time there is no doubt that both have the same clock."""
_MIN_FIXES_S: Final = 2.0
_FIX_ERROR_S: Final = 1.0
_DATE_ERROR_S: Final = 2.0
"""Difference of a date and the received time that is within the delay of the messages."""

_Transducer = tuple[Side, int]
_Values = dict[str, float]


class SessionClock(NamedTuple):
    """Date of a session, and time since the computer was started then; None if unknown."""

    utc_s: float
    uptime_s: float | None


@dataclass(frozen=True, slots=True)
class Profile:
    """Profile of one transducer.

    Attributes:
        place: Place in the file.
        segment: Number of the segment.
        session: Clock of the session that the profile is in, if any.
        number: Ping number of the transducer.
        clock_s: Clock of the transducer.
        channel: Samples; the index is the channel number.
        received: What the packets before the profile contain.
        heading_deg: Heading in the profile itself.
    """

    place: str
    segment: int
    session: SessionClock | None
    number: int
    clock_s: float
    channel: ChannelPing
    received: Received
    heading_deg: float | None

    @property
    def transducer(self) -> _Transducer:
        """Side and channel number."""
        return self.channel.side, self.channel.index


def has_restarted(clock_s: float, last_s: float) -> bool:
    """Return whether a clock that has gone back is that of a sonar that has restarted, not a single wrong value."""
    return clock_s < min(last_s - _RESTART_S, last_s / 2)


class Timeline:
    """Converts the segments of a recording, in their order, to pings."""

    def __init__(self, file: CheckedFile, notes: Notes) -> None:
        self._file, self._notes = file, notes
        self._session: SessionClock | None = None
        self._known: dict[_Transducer, tuple[float, float]] = {}
        """Time minus clock, and last clock, of each transducer in the session."""
        self._last: tuple[float, float] | None = None
        """Time of the last profile in the session, and what had elapsed by the messages."""
        self._seen: dict[str, tuple[int, float]] = {}
        """Number of profiles before each message, and its time."""
        self._latest_s = -math.inf

    def pings(self, segment: Iterator[Profile]) -> Iterator[Ping]:
        """Yield the pings of a segment; none, with a note, if it has no date."""
        head = list(islice(segment, _HEAD_PROFILES))
        clocks = _Clocks(head, self._notes)
        offset_s = math.nan
        with self._notes.leaving_out(head[0].place):
            offset_s = self._offset_s(head, clocks)
        if math.isnan(offset_s):
            self._notes.add("left out profile without a date", len(head) + sum(1 for _ in segment))
            return
        pings = joined(
            self._parts(chain(head, segment), clocks, offset_s),
            max_gap_s=_SAME_NUMBER_S if clocks.by_number else clocks.max_gap_s,
            by_number=clocks.by_number,
            held_pings=_HELD_PINGS,
            reorder_s=_BATCH_S,
        )
        yield from map(_ping, _interpolated(pings))

    def _parts(self, profiles: Iterator[Profile], clocks: _Clocks, offset_s: float) -> Iterator[PingPart[_Values]]:
        for profile in profiles:
            time_s = clocks.common_s(profile) + offset_s
            values = self._values(profile, time_s)
            self._known[profile.transducer] = (time_s - profile.clock_s, profile.clock_s)
            self._last = (time_s, profile.received.elapsed_s)
            yield PingPart(clocks.number(profile), time_s, values, (profile.channel,))

    def _values(self, profile: Profile, time_s: float) -> _Values:
        """Return the values of the messages that are not too old, and the time of the position.

        A message is as late as the profiles before it in the file, or as the next one.
        """
        values = {} if profile.heading_deg is None else {"heading_deg": profile.heading_deg}
        self._latest_s = self._latest_s if 0 < self._latest_s - time_s <= _BATCH_S else time_s
        for name, (row, value) in profile.received.values.items():
            if self._seen.get(name, (-1, 0.0))[0] != row:
                self._seen[name] = (row, self._latest_s)
            if abs(time_s - self._seen[name][1]) <= _VALID_S:
                values[name] = value
        if "lat_deg" in values:
            values["fix_s"] = self._seen["lat_deg"][1]
        return values

    def _offset_s(self, head: list[Profile], clocks: _Clocks) -> float:
        """Return the time of a profile minus the common clock.

        Raises:
            SurveyFileError: Nothing in the file has a date.
        """
        first = head[0]
        if first.session is not self._session:
            self._session, self._known, self._last = first.session, {}, None
        time_s, doubt = self._first_time_s(head)
        offset_s = time_s - clocks.common_s(first)
        received_s = _received_s(head, clocks)
        if received_s is not None and abs(offset_s - received_s) <= _DATE_ERROR_S:
            doubt = ""
        elif received_s is not None:
            other = "no date" if math.isnan(offset_s) else f"a date that is {offset_s - received_s:+.0f} s off"
            doubt = f"times are those of NMEA or MAVLink messages, right to about 1 s: the session has {other}"
            offset_s = received_s
        if math.isnan(offset_s):
            where, expected = f"{first.place}, date", "a recording with its date"
            raise self._file.error(where, "no session packet (10) before it", expected)
        if doubt:
            self._notes.add(doubt)
        return offset_s

    def _first_time_s(self, head: list[Profile]) -> tuple[float, str]:
        """Return the time of the first profile, NaN if it has no date, and a note if it is uncertain."""
        first = head[0]
        for profile in {each.transducer: each for each in reversed(head)}.values():
            offset_s, last_s = self._known.get(profile.transducer, (0.0, math.inf))
            if not has_restarted(profile.clock_s, last_s):
                return profile.clock_s + offset_s, ""
        elapsed_s = first.received.elapsed_s
        if self._last is not None:
            last_s, last_elapsed_s = self._last
            restart = "a sonar restarts: times after it are "
            if elapsed_s > last_elapsed_s:
                return last_s + elapsed_s - last_elapsed_s, restart + "right to about 1 s, by the MAVLink messages"
            return last_s + first.clock_s, restart + "early by the unknown time that it was off"
        if first.session is None:
            return math.nan, ""
        utc_s, uptime_s = first.session
        after_s = math.inf if uptime_s is None else first.clock_s - uptime_s
        if _SAME_CLOCK_S[0] <= after_s <= _SAME_CLOCK_S[1]:
            doubt = f"clocks of sonar and computer differ by {after_s:.0f} s: times may be late by as much"
            return utc_s + after_s, doubt if after_s > _CERTAIN_S else ""
        doubt = (
            "right to about 1 s, by the MAVLink messages" if elapsed_s else "early by the unknown delay of the first"
        )
        return utc_s + elapsed_s, f"profiles have another clock than the session: times are {doubt}"


class _Clocks:
    """Differences of the counters and clocks of the transducers in a segment, relative to the first of them.

    Args:
        head: The first profiles of the segment, at least one.
        notes: Get the differences.
    """

    def __init__(self, head: list[Profile], notes: Notes) -> None:
        of_transducer = defaultdict(list)
        for profile in head:
            of_transducer[profile.transducer].append(profile)
        steps_s = [b.clock_s - a.clock_s for own in of_transducer.values() for a, b in pairwise(own)]
        interval_s = median([step_s for step_s in steps_s if step_s > 0] or [_FIRST_INTERVAL_S])
        self.max_gap_s = _PAIR_INTERVALS * interval_s
        self.by_number = True
        """Whether the numbers of the transducers, with their differences, identify the pings."""
        self._differences: dict[_Transducer, tuple[int, float]] = {}
        first, *others = sorted(of_transducer)
        for transducer in others:
            both = [profile for profile in head if profile.transducer in (first, transducer)]
            reference, own = of_transducer[first], of_transducer[transducer]
            turns_s = [abs(b.clock_s - a.clock_s) for a, b in pairwise(both) if a.transducer != b.transducer]
            has_other_clock = len(turns_s) > 2 and min(turns_s) > _SAME_CLOCK_INTERVALS * interval_s
            shift_s = own[0].clock_s - reference[0].clock_s if has_other_clock else 0.0
            difference = _difference(reference, own, shift_s, self.max_gap_s)
            self._differences[transducer] = (difference or 0, shift_s)
            if shift_s:
                notes.add(f"clocks of the transducers differ by {abs(shift_s):.4g} s")
            if difference is None:
                self.by_number = False
                notes.add("ping numbers of the transducers are unrelated: profiles are joined by time")
            elif difference:
                notes.add(f"ping numbers of the transducers differ by {abs(difference)}")

    def number(self, profile: Profile) -> int:
        """Return the number of a profile by the counter of the first transducer."""
        return profile.number + self._differences.get(profile.transducer, (0, 0.0))[0]

    def common_s(self, profile: Profile) -> float:
        """Return the clock of the first transducer at the time of a profile."""
        return profile.clock_s - self._differences.get(profile.transducer, (0, 0.0))[1]


def _interpolated(pings: Iterator[PingPart[_Values]]) -> Iterator[PingPart[_Values]]:
    """Yield the pings with positions between that of the last message and that of the next, by time."""
    waiting: list[PingPart[_Values]] = []
    for ping in pings:
        if waiting and waiting[0].head.get("fix_s") != ping.head.get("fix_s"):
            _interpolate(waiting, waiting[0].head.copy(), ping.head)
            yield from waiting
            waiting.clear()
        waiting.append(ping)
        if len(waiting) > _HELD_PINGS:
            yield waiting.pop(0)
    yield from waiting


def _interpolate(pings: list[PingPart[_Values]], before: _Values, after: _Values) -> None:
    span_s = after.get("fix_s", math.nan) - before.get("fix_s", math.nan)
    if not 0 < span_s <= _VALID_S:
        return
    start, end = (Position(each["lat_deg"], each["lon_deg"]) for each in (before, after))
    distance_m = math.hypot(*offset_between_m(start, end))
    if distance_m > _MAX_SPEED_MPS * span_s or abs(end.lon_deg - start.lon_deg) > 180:
        return
    for ping in pings:
        share = min(max((ping.time_utc_s - before["fix_s"]) / span_s, 0.0), 1.0)
        for name in ("lat_deg", "lon_deg"):
            ping.head[name] += share * (after[name] - before[name])


def _ping(part: PingPart[_Values]) -> Ping:
    values: dict[str, Any] = {name: value for name, value in part.head.items() if name != "fix_s"}
    return Ping(max(part.number, 0), part.time_utc_s, part.channels, **values)


def _difference(reference: list[Profile], own: list[Profile], shift_s: float, max_gap_s: float) -> int | None:
    """Return the difference of the counters of two transducers by the times of their profiles; None if it varies."""
    gaps_s: dict[int, list[float]] = defaultdict(list)
    for one in own:
        for other in reference:
            gap_s = abs(one.clock_s - shift_s - other.clock_s)
            if gap_s <= max_gap_s:
                gaps_s[other.number - one.number].append(gap_s)
    if not gaps_s:
        return 0
    most = max(map(len, gaps_s.values()))
    frequent = [number for number, found in gaps_s.items() if 2 * len(found) > most]
    best = min(frequent, key=lambda number: (round(fmean(gaps_s[number]), 3), number != 0, -len(gaps_s[number])))
    near = sum(map(len, gaps_s.values()))  # up to two for each ping
    varies = 4 * len(gaps_s[best]) < near or 2 * len({profile.number for profile in own}) <= len(own)
    return None if varies else best


def _received_s(head: list[Profile], clocks: _Clocks) -> float | None:
    """Return received UTC minus the common clock; None if there are few, or they do not advance with it."""
    fixes = [(utc_s, utc_s - clocks.common_s(each)) for each in head if (utc_s := each.received.utc_s) is not None]
    if not fixes or max(fixes)[0] - min(fixes)[0] < _MIN_FIXES_S:
        return None
    received_s = median(offset_s for _, offset_s in fixes)
    agreeing = sum(abs(offset_s - received_s) <= _FIX_ERROR_S for _, offset_s in fixes)
    return received_s if 4 * agreeing >= 3 * len(fixes) else None
