"""Sets of byte positions as sorted, disjoint, non-touching half-open ranges `[start, stop)`."""

from __future__ import annotations

Range = tuple[int, int]
Ranges = tuple[Range, ...]


def add_range(ranges: Ranges, start: int, stop: int) -> Ranges:
    """Return `ranges` with `[start, stop)` united into it; ranges that touch become one."""
    if start >= stop:
        return ranges
    before = [r for r in ranges if r[1] < start]
    after = [r for r in ranges if r[0] > stop]
    joined = ranges[len(before) : len(ranges) - len(after)]
    if joined:
        start, stop = min(start, joined[0][0]), max(stop, joined[-1][1])
    return (*before, (start, stop), *after)


def covered_within(ranges: Ranges, start: int, stop: int) -> Ranges:
    """Return the parts of `[start, stop)` that `ranges` covers."""
    return tuple((max(a, start), min(b, stop)) for a, b in ranges if a < stop and b > start)


def gaps_within(ranges: Ranges, start: int, stop: int) -> Ranges:
    """Return the parts of `[start, stop)` that `ranges` does not cover."""
    gaps: list[Range] = []
    position = start
    for a, b in covered_within(ranges, start, stop):
        if a > position:
            gaps.append((position, a))
        position = b
    if position < stop:
        gaps.append((position, stop))
    return tuple(gaps)


def count_positions(ranges: Ranges) -> int:
    """Return how many positions `ranges` covers."""
    return sum(stop - start for start, stop in ranges)
