"""A token bucket: how many bytes may go over a thin link, and when."""

from __future__ import annotations

RESOLUTION_S = 1e-6
"""Shorter waits are none: rounding leaves some that no clock can measure."""


class TokenBucket:
    """Bytes that may be sent now; pure, `now_s` comes in with every call (any clock that does not go back).

    The bucket fills at `rate_bytes_per_s` up to `burst_bytes`. What is urgent is sent at once and charged all the same:
    the level falls below zero and whatever is not urgent waits for as long as the debt lasts, so the mean rate holds.

    Args:
        rate_bytes_per_s: Mean rate, above 0.
        burst_bytes: Most that may go at once after a pause, above 0.
        now_s: Time of the first moment; the bucket begins full.
    """

    def __init__(self, rate_bytes_per_s: float, burst_bytes: float, now_s: float) -> None:
        self._rate_bytes_per_s = rate_bytes_per_s
        self._burst_bytes = burst_bytes
        self._level_bytes = burst_bytes
        self._at_s = now_s

    def wait_s(self, size_bytes: int, now_s: float) -> float:
        """Return for how many seconds `size_bytes` have to wait, 0.0 for not at all.

        More than the burst goes when the bucket is full: it would never go otherwise.
        """
        self._fill(now_s)
        wanted = min(float(size_bytes), self._burst_bytes)
        wait_s = (wanted - self._level_bytes) / self._rate_bytes_per_s
        return wait_s if wait_s > RESOLUTION_S else 0.0

    def take(self, size_bytes: int, now_s: float) -> None:
        """Charge `size_bytes`, whether they were there or not."""
        self._fill(now_s)
        self._level_bytes -= size_bytes

    def _fill(self, now_s: float) -> None:
        gained = max(0.0, now_s - self._at_s) * self._rate_bytes_per_s
        self._level_bytes = min(self._burst_bytes, self._level_bytes + gained)
        self._at_s = max(self._at_s, now_s)
