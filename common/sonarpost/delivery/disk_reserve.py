"""Room on the disk of a store: records are left with their senders before there is none."""

from __future__ import annotations

import shutil

from sonarpost.delivery.inbox import RetryLaterError
from sonarpost.delivery.store import Store

HANDLING_RESERVE_BYTES = 8_388_608
"""What handling needs on the disk to get rid of what is there: to delete is to write, into the write-ahead log."""


class DiskReserve:
    """Keeps a reserve on the disk of a store.

    A store's file never becomes smaller, so what lies free inside of it counts as free: else a store that was full once
    would take nothing any more, however empty it is.

    Args:
        store: The store.
        reserve_bytes: What is to stay free.
        consequence: What the reserve keeps from being taken, for people.
    """

    def __init__(self, store: Store, reserve_bytes: int, consequence: str) -> None:
        self._store = store
        self._reserve_bytes = reserve_bytes
        self._consequence = consequence
        self._full = False

    def free_bytes(self) -> int:
        """Return how much can still be stored.

        Raises:
            HandoffError: The store cannot be read.
        """
        return shutil.disk_usage(self._store.path.parent).free + self._store.reusable_bytes()

    def require(self) -> None:
        """Check for room.

        Raises:
            RetryLaterError: The reserve is touched.
        """
        text = self._lacking()
        if text:
            raise RetryLaterError(text)

    def degraded_reason(self) -> str:
        """Say that records are left with their senders, while that is so; looks again only where it was."""
        return self._lacking() if self._full else ""

    def _lacking(self) -> str:
        free_bytes = self.free_bytes()
        self._full = free_bytes < self._reserve_bytes
        if not self._full:
            return ""
        folder = self._store.path.parent
        return f"{folder}: {free_bytes} bytes free, below the reserve of {self._reserve_bytes}: {self._consequence}"
