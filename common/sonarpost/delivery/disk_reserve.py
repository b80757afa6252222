"""Minimum free disk space of a store."""

from __future__ import annotations

import shutil

from sonarpost.delivery.store import Store
from sonarpost.errors import DeliveryError, RetryLaterError

HANDLING_RESERVE_BYTES = 8_388_608
"""Free space for handling the accepted records: deleting rows writes to the write-ahead log."""


class DiskReserve:
    """Minimum free disk space of a store; below it no records are accepted.

    The file of a store never shrinks. Free space inside it counts as free, so that a store that was once full can
    accept records again after it was emptied.

    Args:
        store: The store.
        reserve_bytes: Space that has to stay free.
        consequence: Effect of the reached reserve, for the health record.
    """

    def __init__(self, store: Store, reserve_bytes: int, consequence: str) -> None:
        self._store = store
        self._folder = store.path.parent
        self._reserve_bytes = reserve_bytes
        self._consequence = consequence
        self._reached = False
        self._rejection = ""

    def require(self) -> None:
        """Check the free space.

        Raises:
            RetryLaterError: It is below the reserve.
        """
        if reason := self._check():
            self._rejection = reason
            raise RetryLaterError(reason)

    def degraded_reason(self) -> str:
        """Return why a record was rejected since the last call, or why none are accepted; empty without a reason."""
        rejection, self._rejection = self._rejection, ""
        if not self._reached:
            return rejection
        failure = ""
        try:
            # Only new records would return this space, and none are accepted.
            self._store.truncate_log()
        except DeliveryError as error:
            failure = str(error)
        return self._check() or rejection or failure

    def _check(self) -> str:
        free_bytes = shutil.disk_usage(self._folder).free
        if free_bytes < self._reserve_bytes:
            free_bytes += self._store.reusable_bytes()
        self._reached = free_bytes < self._reserve_bytes
        if not self._reached:
            return ""
        reserve = f"the reserve of {self._reserve_bytes}"
        return f"{self._folder}: {free_bytes} bytes free, below {reserve}: {self._consequence}"
