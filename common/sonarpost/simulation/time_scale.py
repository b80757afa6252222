"""Simulated time that runs faster or slower than the wall clock.

Nothing here reads a clock: the caller hands in its own monotonic reading, so that the same code serves a live
process and a test that counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimeScale:
    """Maps a monotonic reading to simulated seconds: simulated = real x scale, from zero at `started_s`.

    Attributes:
        scale: Simulated seconds a real second, above zero and finite; 1 is real time.
        started_s: The monotonic reading, in real seconds, at which simulated time is zero.

    Raises:
        ValueError: A scale that is not a positive finite number.
    """

    scale: float = 1.0
    started_s: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"time scale: got {self.scale!r}, expected a finite number above zero")

    def simulated_s(self, real_s: float) -> float:
        """Return the simulated time at the monotonic reading `real_s`."""
        return (real_s - self.started_s) * self.scale

    def real_s(self, simulated_s: float) -> float:
        """Return the monotonic reading at which simulated time will be `simulated_s`."""
        return self.started_s + simulated_s / self.scale

    def wait_s(self, simulated_s: float, real_s: float) -> float:
        """Return the real seconds from the reading `real_s` until `simulated_s`, never below zero."""
        return max(0.0, self.real_s(simulated_s) - real_s)
