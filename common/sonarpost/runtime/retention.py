"""Retention of a service: its configuration, and the thread that applies it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Annotated, Final

from pydantic import Field

from sonarpost.config import ServiceConfig
from sonarpost.errors import DeliveryError
from sonarpost.limits import limit
from sonarpost.logs import kv

log = logging.getLogger(__name__)

INTERVAL_S = 60.0
STEP_S = 3600.0
MAX_BYTES: Final = limit(
    20_000_000_000, "bytes", "shares", "stored files", "source", "default of `max_bytes`", "the largest loses items"
)
FOLLOW_AFTER_S: Final = limit(
    86400.0, "s", "shares", "clock of the host", "time server", "after a start or step", "nothing is removed by age"
)

RetainDays = Annotated[float, Field(gt=0, le=36500)]
MaxBytes = Annotated[int, Field(ge=0)]


class RetentionConfig(ServiceConfig):
    """Base class of the tables of services that store files or images.

    Attributes:
        retain_days: Age in days above which files or images are removed.
        max_bytes: Maximum size of the files or images in bytes; above it the oldest of the largest source are removed.
    """

    retain_days: RetainDays = 365.0
    max_bytes: MaxBytes = MAX_BYTES


class SteadyTime:
    """Wall clock that follows a step only after a day, so that a wrong clock does not make all files old at once.

    The start counts as a step from 1970.
    """

    def __init__(self) -> None:
        self._offset_s = 0.0
        self._stepped_s: float | None = time.monotonic()

    def now_utc_s(self) -> float:
        """Return the wall clock; for a day after a step of more than an hour, the earlier of new and previous time."""
        wall_s, steady_s = time.time(), time.monotonic()
        step_s = wall_s - steady_s - self._offset_s
        if abs(step_s) > STEP_S:
            if self._stepped_s is None:
                self._stepped_s = steady_s
                log.warning("Clock was set; retention follows it after a day", extra=kv(step_s=round(step_s)))
            if steady_s - self._stepped_s < FOLLOW_AFTER_S:
                return min(wall_s, steady_s + self._offset_s)
        self._offset_s = wall_s - steady_s
        self._stepped_s = None
        return wall_s


class Retention:
    """Removes what is too old or too much, every minute and after `wake`.

    Args:
        remove: Removes what the limits exceed, and counts it. Receives the time that ages refer to, UTC in seconds; see
            `SteadyTime`.
        stopping: Ends `run`.
    """

    def __init__(self, remove: Callable[[float], None], stopping: threading.Event) -> None:
        self._remove = remove
        self._stopping = stopping
        self._due = threading.Event()
        self._time = SteadyTime()
        self.error = ""
        """Why the last removal failed; empty if it did not."""

    def wake(self) -> None:
        """Apply the limits now, or end if the service stops."""
        self._due.set()

    def run(self) -> None:
        """Apply the limits until the service stops."""
        while not self._stopping.is_set():
            self._due.clear()
            try:
                self._remove(self._time.now_utc_s())
                self.error = ""
            except Exception as error:
                if not isinstance(error, (OSError, DeliveryError)):
                    log.exception("Retention failed after an unexpected exception; trying again")
                self.error = f"stored files cannot be removed: {error}"
                log.error("Retention failed", extra=kv(reason=str(error)))
            self._due.wait(INTERVAL_S)
