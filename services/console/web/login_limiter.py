"""Limits of password checks: token buckets that are charged before a password is checked."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from sonarpost.limits import limit
from sonarpost.services.console.web.access import ApiError


@dataclass(frozen=True, slots=True)
class Rate:
    """A number of attempts at once, and the time in which one more is permitted."""

    burst: int
    interval_s: float


RATE_OF_SOURCE: Final = Rate(
    limit(
        5, "attempts", "shares", "log-in", "browser, address", "wrong passwords of a user", "429; one more after 60 s"
    ),
    60.0,
)
"""Wrong passwords of one user from one source: a known browser, a network address, or a session."""
RATE_OF_ADDRESS: Final = Rate(
    limit(20, "attempts", "shares", "log-in", "address", "wrong passwords of all users", "429; one more after 15 s"),
    15.0,
)
"""Wrong passwords from unknown browsers at one network address."""
RATE_OF_USER: Final = Rate(100, 10.0)
"""Wrong passwords of one user from all unknown browsers."""
MAX_CHECKS: Final = limit(
    8, "checks", "shares", "log-in", "all unknown browsers", "checks that run or wait", "503, Retry-After"
)
"""Password checks at a time, running and waiting, of unknown browsers; as many again of known ones."""
BUSY_RETRY_S: Final = 5
ROUNDING_S: Final = 1e-3
MAX_NAME: Final = 41
"""Longer than the longest name of a user."""


class LoginLimiter:
    """Limits wrong passwords without locking users out.

    An attempt is charged to several buckets before its password is checked, and refunded if the password is correct.
    Parallel attempts therefore do not pass the limits. A browser that has logged in before has its own bucket: wrong
    passwords from other browsers and addresses do not delay it.

    Args:
        clock: Monotonic seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._full_at_s: dict[tuple[str, ...], float] = {}
        """Time at which a bucket is full again, by name; full buckets are deleted."""
        self._checks = {known: threading.BoundedSemaphore(MAX_CHECKS) for known in (True, False)}

    def buckets_of_login(self, user: str, address: str, device: str | None) -> Mapping[tuple[str, ...], Rate]:
        """Return the buckets of a log-in.

        Args:
            user: Name of the user, who need not exist.
            address: Network address, or group of addresses.
            device: Token of a browser that is known for this user; None for any other.
        """
        user = user[:MAX_NAME]
        if device is not None:
            return {("device", user, device): RATE_OF_SOURCE}
        return {
            ("user at address", user, address): RATE_OF_SOURCE,
            ("address", address): RATE_OF_ADDRESS,
            ("user", user): RATE_OF_USER,
        }

    def buckets_of_session(self, token: str) -> Mapping[tuple[str, ...], Rate]:
        """Return the buckets of a password change; an unattended page could be used to guess the password."""
        return {("session", token): RATE_OF_SOURCE}

    def buckets_of_link(self, address: str) -> Mapping[tuple[str, ...], Rate]:
        """Return the buckets of a log-in link from a network address, or group of addresses."""
        return {("link at address", address): RATE_OF_ADDRESS}

    @contextmanager
    def attempt(self, buckets: Mapping[tuple[str, ...], Rate], *, known: bool) -> Iterator[Callable[[], None]]:
        """Charge an attempt and limit the number of checks. Yields a function that refunds the attempt.

        Raises:
            ApiError: 429 if a bucket is empty; 503 if too many checks are waiting.
        """
        wait_s = self._charge(buckets)
        if wait_s > 0:
            seconds = int(wait_s) + 1
            message = f"too many failed attempts: try again in {seconds} s"
            raise ApiError(429, "too_many", message, headers={"Retry-After": str(seconds)})
        if not self._checks[known].acquire(blocking=False):
            self._refund(buckets)
            headers = {"Retry-After": str(BUSY_RETRY_S)}
            message = f"too many log-ins at this moment: try again in {BUSY_RETRY_S} s"
            raise ApiError(503, "busy", message, headers=headers)
        try:
            yield lambda: self._refund(buckets)
        finally:
            self._checks[known].release()

    def _charge(self, buckets: Mapping[tuple[str, ...], Rate]) -> float:
        """Charge all buckets and return 0; if one is empty, charge none and return the time to wait."""
        with self._lock:
            now_s = self._clock()
            # Full buckets are deleted, so that invented names do not fill the memory.
            self._full_at_s = {name: at_s for name, at_s in self._full_at_s.items() if at_s > now_s}
            charged = {
                name: max(now_s, self._full_at_s.get(name, now_s)) + rate.interval_s for name, rate in buckets.items()
            }
            wait_s = max(charged[name] - now_s - rate.burst * rate.interval_s for name, rate in buckets.items())
            if wait_s > ROUNDING_S:
                return wait_s
            self._full_at_s |= charged
            return 0.0

    def _refund(self, buckets: Mapping[tuple[str, ...], Rate]) -> None:
        with self._lock:
            for name, rate in buckets.items():
                if name in self._full_at_s:
                    self._full_at_s[name] -= rate.interval_s
