"""What of the v1 link outlives the process: only what has changed is written, all of it in one transaction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction
from sonarpost.link.state import SavedParts

_PREFIX: Final = "v1/"
ARRIVAL: Final = "arrival/"
"""Records that were accepted and are not in the queue yet."""


class LineStore:
    """Named parts of the v1 link's state.

    Args:
        store: The service's.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._saved = SavedParts({})
        self._arrivals = max((_number(name) for name in store.state_names(ARRIVAL)), default=0)

    def load(self) -> dict[str, bytes]:
        """Return the parts that were saved."""
        parts = {
            name.removeprefix(_PREFIX): self._store.get_state(name) or b"" for name in self._store.state_names(_PREFIX)
        }
        self._saved = SavedParts(parts)
        return parts

    def quarantine(self, reasons: Mapping[str, str]) -> None:
        """Keep parts apart as they are on the disk, where a person can find them, before others take their place.

        Args:
            reasons: Why, by the part's name.

        Raises:
            HandoffError: The disk refused.
        """
        with self._store.transaction() as tx:
            for name, reason in reasons.items():
                tx.quarantine("in", f"state {_PREFIX}{name}", self._store.get_state(_PREFIX + name) or b"", reason)

    def write(self, tx: Transaction, parts: Mapping[str, bytes]) -> None:
        """Write the parts that differ from those on the disk; call `wrote` after the commit."""
        for name, data in self._saved.changes(parts).items():
            if data is None:
                tx.delete_state(_PREFIX + name)
            else:
                tx.put_state(_PREFIX + name, data)

    def wrote(self, parts: Mapping[str, bytes]) -> None:
        """Record that the transaction of `write` is committed."""
        self._saved.commit(parts)

    def arrival_name(self) -> str:
        """Return the name of a state for the next record that is accepted."""
        self._arrivals += 1
        return f"{ARRIVAL}{self._arrivals:016d}"

    def arrivals(self, most: int) -> Iterator[tuple[str, bytes]]:
        """Return records that are not in the queue yet, the oldest first."""
        for name in self._store.state_names(ARRIVAL)[:most]:
            payload = self._store.get_state(name)
            if payload is not None:
                yield name, payload


def _number(name: str) -> int:
    return int(name.removeprefix(ARRIVAL))
