"""Channel sets of a recording: a sonar with two frequencies has two channels a side, of which an image needs one.

A channel set is what may be beside each other in an image: channels of one frequency, at most one a side. If the file
does not state frequencies, the order of the channels on each side separates the sets, and if a recorder alternates
between two ranges, the range.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Final

from typing_extensions import override

from sonarpost.sonar.survey import ChannelPing, Ping, Side

_FREQUENCY_STEPS: Final = 24
"""Steps an octave in which frequencies are counted."""
_SAME_FREQUENCY: Final = 1.2
"""Greatest ratio of neighbouring frequencies of one set: the sides of a sonar may differ, and a chirp may vary."""
_RANGE_STEPS: Final = 8
"""Steps an octave in which ranges are counted."""
_ALTERNATING: Final = 0.2
"""Share of the pings with another range than the ping before, from which ranges alternate: an operator changes the
range once in many pings."""
_ENOUGH_PINGS: Final = 0.5
"""Share of the most frequent set that the set of the highest frequency must have to be the default."""
_RARE: Final = 0.02
"""Share of the channels of a side and frequency up to which an index counts as damaged."""
_MAX_COMBINATIONS: Final = 1024

_Key = tuple[int | None, int, int]
"""Step of the frequency, index of the channel, step of the range."""


@dataclass(frozen=True, slots=True)
class ChannelSet:
    """One frequency of a sonar.

    Attributes:
        frequency_hz: Mean frequency; None if unknown.
        range_m: Slant range, if it tells the sets apart; else None.
        ping_count: Number of pings that have a channel of the set.
    """

    frequency_hz: float | None
    range_m: float | None
    ping_count: int

    @override
    def __str__(self) -> str:
        frequency = "unknown frequency" if self.frequency_hz is None else f"{self.frequency_hz / 1000:.4g} kHz"
        return frequency if self.range_m is None else f"{frequency}, {self.range_m:.4g} m"


class ChannelChoice:
    """Finds the channel sets of a recording in the first pass, and selects the channels of one of them.

    Args:
        frequency_hz: The frequency to select; None for the highest of those that at least half as many pings have as
            the most frequent one.
    """

    def __init__(self, frequency_hz: float | None) -> None:
        self._wanted_hz = frequency_hz
        self._counts: Counter[tuple[Side, _Key]] = Counter()
        self._sums_hz: dict[int | None, float] = {}
        self._numbers: Counter[int | None] = Counter()
        self._last_range: dict[tuple[Side, int | None, int], int] = {}
        self._changes: Counter[tuple[Side, int | None, int]] = Counter()
        self._set_of: dict[tuple[Side, _Key], int] = {}
        self._chosen = 0
        self.sets: tuple[ChannelSet, ...] = ()
        """After `choose`: the sets, the highest frequency first."""
        self.left_out = 0
        """After `choose`: number of pings without a channel of the chosen set."""
        self._combinations: Counter[frozenset[tuple[Side, _Key]]] = Counter()

    def observe(self, ping: Ping) -> None:
        """Count the channels of a ping in the first pass.

        Raises:
            ValueError: More than 1024 combinations of frequency, range and channel: not those of a sonar.
        """
        if not ping.channels:
            return
        found = set()
        for channel in ping.channels:
            key = _key(channel)
            found.add((channel.side, key))
            self._counts[channel.side, key] += 1
            self._sums_hz[key[0]] = self._sums_hz.get(key[0], 0.0) + (channel.frequency_hz or 0.0)
            self._numbers[key[0]] += 1
            place = (channel.side, key[0], key[1])
            self._changes[place] += self._last_range.get(place, key[2]) != key[2]
            self._last_range[place] = key[2]
        self._combinations[frozenset(found)] += 1
        if len(self._combinations) > _MAX_COMBINATIONS:
            raise ValueError(f"over {_MAX_COMBINATIONS} combinations of frequency and range")

    def choose(self) -> None:
        """Divide the channels into sets, after the first pass, and choose one."""
        clusters = _clusters({key[0] for _, key in self._counts})
        ranks = self._ranks(clusters)
        alternating = {
            place
            for place, changes in self._changes.items()
            if changes > max(1, _ALTERNATING * sum(n for (s, k), n in self._counts.items() if (s, k[0], k[1]) == place))
        }
        members: dict[tuple[int, int, int | None], list[tuple[Side, _Key]]] = {}
        for side, key in self._counts:
            step = key[2] if (side, key[0], key[1]) in alternating else None
            members.setdefault((clusters[key[0]], ranks[side, key[0], key[1]], step), []).append((side, key))
        described = []
        for (_, rank, step), keys in members.items():
            count = sum(n for combination, n in self._combinations.items() if not combination.isdisjoint(keys))
            steps = {key[0] for _, key in keys}
            frequency_hz = sum(self._sums_hz[s] for s in steps) / sum(self._numbers[s] for s in steps) or None
            range_m = None if step is None else 2 ** (step / _RANGE_STEPS)
            described.append((ChannelSet(frequency_hz, range_m, count), rank, keys))
        described.sort(key=lambda each: (-(each[0].frequency_hz or 0.0), each[1], each[0].range_m or 0.0))
        self.sets = tuple(each for each, _, _ in described)
        self._set_of = {member: number for number, (_, _, keys) in enumerate(described) for member in keys}
        self._chosen = self._choice()
        if self.sets:
            self.left_out = self._combinations.total() - self.sets[self._chosen].ping_count

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides of the chosen set, port first; after `choose`."""
        present = {side for (side, _), number in self._set_of.items() if number == self._chosen}
        return tuple(side for side in Side if side in present)

    def select(self, ping: Ping) -> Ping | None:
        """Return the ping with the channels of the chosen set alone, port first; None if it has only others."""
        if not ping.channels:
            return None
        channels: dict[Side, ChannelPing] = {}
        for channel in ping.channels:
            if self._set_of.get((channel.side, _key(channel))) == self._chosen:
                channels.setdefault(channel.side, channel)
        if not channels:
            return None
        ordered = tuple(channels[side] for side in Side if side in channels)
        is_same = [*map(id, ordered)] == [*map(id, ping.channels)]  # arrays have no equality
        return ping if is_same else replace(ping, channels=ordered)

    def warnings(self) -> list[str]:
        """Return notes on the choice, if the file has several sets."""
        if len(self.sets) < 2:
            return []
        names = "; ".join(f"{each} in {each.ping_count} pings" for each in self.sets)
        chosen = self.sets[self._chosen]
        lines = [f"{len(self.sets)} channel sets: {names}; images and contacts are of {chosen} (option frequency_hz)"]
        if self._wanted_hz is not None and not _is_near(chosen.frequency_hz, self._wanted_hz):
            lines.append(f"no channels of {self._wanted_hz / 1000:.4g} kHz (option frequency_hz)")
        if self.left_out:
            lines.append(f"left out pings without a channel of {chosen}: {self.left_out}")
        return lines

    def _ranks(self, clusters: dict[int | None, int]) -> dict[tuple[Side, int | None, int], int]:
        """Return the order of each channel among those of its side and frequency, by its index; rare ones are last."""
        counts: dict[tuple[Side, int], Counter[int]] = {}
        for (side, (step, index, _)), count in self._counts.items():
            counts.setdefault((side, clusters[step]), Counter())[index] += count
        order = {
            place: sorted(found, key=lambda index: (found[index] <= _RARE * max(found.values()), index))
            for place, found in counts.items()
        }
        return {
            (side, step, index): order[side, clusters[step]].index(index) for side, (step, index, _) in self._counts
        }

    def _choice(self) -> int:
        """Return the number of the chosen set."""
        if not self.sets:
            return 0
        if self._wanted_hz is not None:
            wanted_hz = self._wanted_hz
            return min(
                range(len(self.sets)), key=lambda number: _octaves(self.sets[number].frequency_hz or 1.0, wanted_hz)
            )
        most = max(each.ping_count for each in self.sets)
        return next(n for n, each in enumerate(self.sets) if each.ping_count >= _ENOUGH_PINGS * most)


def is_same_frequency(one: ChannelPing, other: ChannelPing) -> bool:
    """Return whether two channels can be of one image: frequencies of one set, or unknown."""
    return not one.frequency_hz or not other.frequency_hz or _is_near(one.frequency_hz, other.frequency_hz)


def _key(channel: ChannelPing) -> _Key:
    step = None if not channel.frequency_hz else round(math.log2(channel.frequency_hz) * _FREQUENCY_STEPS)
    return step, channel.index, round(math.log2(max(channel.slant_range_m, 1e-3)) * _RANGE_STEPS)


def _clusters(steps: set[int | None]) -> dict[int | None, int]:
    """Return the number of the frequency of each step: neighbours that are close are one frequency."""
    clusters: dict[int | None, int] = {None: -1}
    number, last = 0, -math.inf
    for step in sorted(step for step in steps if step is not None):
        number += step - last > math.log2(_SAME_FREQUENCY) * _FREQUENCY_STEPS
        clusters[step], last = number, step
    return clusters


def _octaves(one_hz: float, other_hz: float) -> float:
    return abs(math.log2(one_hz / other_hz))


def _is_near(found_hz: float | None, wanted_hz: float) -> bool:
    return found_hz is not None and _octaves(found_hz, wanted_hz) <= math.log2(_SAME_FREQUENCY)
