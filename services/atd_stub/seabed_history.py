"""Difficulty of the seabed in the latest survey files, for the health record. It is kept in memory and not stored."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Mapping
from typing import Final

from sonarpost.detection.difficulty import Difficulty, unreliable_text

WORST_OF_S: Final = 3600.0
"""Time over which the worst expected probability of detection is reported."""
_MAX_FILES: Final = 10_000


class SeabedHistory:
    """Difficulties of the files of the last hour; safe for several threads. Times are monotonic."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last: Difficulty | None = None
        self._recent: deque[tuple[float, Difficulty]] = deque(maxlen=_MAX_FILES)

    def add(self, difficulty: Difficulty | None, now_s: float) -> None:
        """Add the difficulty of a file; None if too little of its seabed is known."""
        with self._lock:
            self._last = difficulty
            if difficulty is not None:
                self._recent.append((now_s, difficulty))

    def gauges(self, now_s: float) -> Mapping[str, float]:
        """Return the values of the last file and the worst expected Pd of the last hour, without unknown values."""
        with self._lock:
            while self._recent and now_s - self._recent[0][0] > WORST_OF_S:
                self._recent.popleft()
            found: dict[str, float] = {}
            if self._last is not None:
                found["expected_pd"] = round(self._last.expected_pd, 3)
                found["clutter_per_1000_m2"] = round(self._last.clutter_per_1000_m2, 2)
                found["ripple_strength"] = round(self._last.ripple_strength, 3)
            if self._recent:
                found["worst_expected_pd"] = round(min(d.expected_pd for _, d in self._recent), 3)
            return found

    def warning(self) -> str:
        """Return that a result without contacts has no meaning on the seabed of the last file; else empty."""
        with self._lock:
            if self._last is None or self._last.is_reliable:
                return ""
            return unreliable_text(self._last.expected_pd)
