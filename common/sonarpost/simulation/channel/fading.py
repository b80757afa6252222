"""Burst fading after Gilbert and Elliott: a path is clear or faded, and changes at times of its own.

How long a path stays as it is is drawn from an exponential distribution, by (seed, path, count) alone: a path has the
same fades whoever transmits when. Both directions of a path fade together.
"""

from __future__ import annotations

import math
from bisect import bisect_right

from sonarpost.simulation.channel.random_draws import RandomDraws


class Fading:
    """The fades of every path in one water. Every path is clear at time zero.

    Args:
        seed: Seed of the simulation.
        mean_clear_s: Mean time a path stays clear.
        mean_fade_s: Mean time of a fade; 0 for none ever.
    """

    def __init__(self, seed: int, mean_clear_s: float, mean_fade_s: float) -> None:
        self._seed = seed
        self._means_s = (mean_clear_s, mean_fade_s)
        # Times at which each path changes; the first change is into a fade.
        self._changes: dict[tuple[int, int], list[float]] = {}

    def faded(self, one: int, other: int, at_s: float) -> bool:
        """Return whether the path between two modems is faded at a time."""
        if self._means_s[1] <= 0.0:
            return False
        path = (min(one, other), max(one, other))
        changes = self._changes.setdefault(path, [])
        while not changes or changes[-1] <= at_s:
            dice = RandomDraws(self._seed, path[0], len(changes), path[1])
            mean_s = self._means_s[len(changes) % 2]
            # 1 - u is above 0, so the logarithm is finite; an instant's stay must still move time on.
            stay_s = max(1e-3, -mean_s * math.log(1.0 - dice.uniform("fading")))
            changes.append((changes[-1] if changes else 0.0) + stay_s)
        return bisect_right(changes, at_s) % 2 == 1
