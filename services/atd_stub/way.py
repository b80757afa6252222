"""How many pictures are between this service and the water, told from what the services on the way report."""

from __future__ import annotations

import threading
from collections import deque

from sonarpost.messages import Health, QueueState

COMPRESSOR = "compressor"
MODEM = "uuv_modem"
QUEUE = "queue"

STALE_S = 600.0
"""A service that has said nothing for this long may have been replaced by another program, and counts no more."""
_MARGIN_S = 0.1
"""What a report says was read so long before the time it bears, at most."""


class WayToTheWater:
    """Counts the pictures on their way: handed over and not yet sent by sound.

    They are counted where they lie: the compressor's inbox and outbox, and uuv_modem's inbox or, on the v1 link, its
    acoustic queue. What the compressor has taken since the oldest of the latest reports is counted besides, as no
    report has it yet: some may be counted twice for a moment, which makes one wait, and none is left out. Nothing here
    needs a report: without any, what was handed over lately counts.

    Times are seconds on one clock that never goes back. Safe to use from several threads; takes no other lock.

    Args:
        grace_s: In this time every service that is there has reported.
        started: Now.
        is_first_run: Nothing was ever handed over; else nothing more is before the reports say what is on the way.
    """

    def __init__(self, grace_s: float, started: float, *, is_first_run: bool) -> None:
        self._grace_s = grace_s
        self._knows_from = started if is_first_run else started + grace_s
        self._lock = threading.Lock()
        self._reports: dict[str, tuple[float, int]] = {}
        self._taken: deque[float] = deque()

    def heard_health(self, health: Health, now: float) -> None:
        """Note what waits in the compressor or in uuv_modem."""
        inbox, outbox = (int(health.gauges.get(name, 0.0)) for name in ("inbox", "outbox"))
        with self._lock:
            if health.service == COMPRESSOR:
                self._reports[COMPRESSOR] = (now, inbox + outbox)
            elif health.service == MODEM:
                self._reports[MODEM] = (now, inbox)
                if "messages_waiting" not in health.gauges:
                    self._reports.pop(QUEUE, None)  # it runs the paper's link now, which has no queue

    def heard_queue(self, state: QueueState, now: float) -> None:
        """Note what waits in the acoustic queue; pictures of which nothing is left to be sent do not."""
        told = sum(image.bytes_left > 0 for image in state.images)
        with self._lock:
            self._reports[QUEUE] = (now, told + max(state.images_waiting - len(state.images), 0))

    def taken(self, now: float) -> None:
        """Note that the compressor has taken one more."""
        with self._lock:
            self._taken.append(now)

    def on_the_way(self, owed: int, now: float) -> int:
        """Return how many pictures are on their way.

        Args:
            owed: Those that the compressor has not taken.
            now: The time.
        """
        with self._lock:
            for name in [n for n, (heard, _) in self._reports.items() if now - heard > STALE_S]:
                del self._reports[name]
            since = self._complete_until(now)
            while self._taken and self._taken[0] < since:
                self._taken.popleft()
            return owed + sum(count for _, count in self._reports.values()) + len(self._taken)

    def room(self, owed: int, limit: int, now: float) -> int:
        """Return how many more may set out so that at most `limit` are on their way."""
        if now < self._knows_from and not self._heard_all():
            return 0
        return max(limit - self.on_the_way(owed, now), 0)

    def _heard_all(self) -> bool:
        with self._lock:
            return COMPRESSOR in self._reports and MODEM in self._reports

    def _complete_until(self, now: float) -> float:
        """Return up to when the reports have whatever was taken."""
        heard = [heard for heard, _ in self._reports.values()]
        if not {COMPRESSOR, MODEM} <= self._reports.keys():
            heard.append(now - self._grace_s)
        return min(heard) - _MARGIN_S
