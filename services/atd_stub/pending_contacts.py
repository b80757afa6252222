"""Durable priority list of the snippets that wait for release: picks of a person first, then the most confident."""

from __future__ import annotations

from collections.abc import Sequence

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.messages import Snippet

_PREFIX = "pending/"
_MAX_CONFIDENCE = 2.0
_STEPS = 1_000_000
_PICK_RANK = -1
"""Sorts before all ranks by confidence: `-` comes before the digits."""


class PendingContacts:
    """Snippets in the service's store.

    The name of a stored snippet sorts by confidence, then by age. Picks come first, other contacts without confidence
    last. All content is in the store: a unit of work that is not committed changes nothing. One thread
    adds, one thread removes.

    Args:
        store: The service's store.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        numbers = (name.rpartition(":")[2] for name in store.state_names(_PREFIX))
        self._next_number = 1 + max((int(number) for number in numbers if number.isdecimal()), default=0)

    def __len__(self) -> int:
        return len(self._store.state_names(_PREFIX))

    def add(self, effects: UnitOfWork, snippets: Sequence[Snippet]) -> None:
        """Queue snippets by falling confidence, then in the order of detection."""
        for snippet in snippets:
            confidence = snippet.contact.atd_confidence
            rank = round((_MAX_CONFIDENCE - (confidence or 0.0)) * _STEPS) + (confidence is None)
            effects.put_state(f"{_PREFIX}{rank:08d}:{self._next_number:015d}", wire.encode(snippet))
            self._next_number += 1

    def add_picks(self, effects: UnitOfWork, snippets: Sequence[Snippet]) -> None:
        """Queue snippets of picks before all others. Those of the same contacts that wait here are removed."""
        picked = {snippet.contact.contact_id for snippet in snippets}
        for name in self._store.state_names(_PREFIX):
            # The other thread may have removed it.
            waiting = self._store.read_state(name, lambda payload: wire.decode(Snippet, payload, "contact"), None)
            if waiting is not None and waiting.contact.contact_id in picked:
                effects.delete_state(name)
        for snippet in snippets:
            effects.put_state(f"{_PREFIX}{_PICK_RANK:08d}:{self._next_number:015d}", wire.encode(snippet))
            self._next_number += 1

    def remove_first(self, effects: UnitOfWork, count: int | None) -> list[bytes]:
        """Remove up to `count` (None for all) of the most confident snippets; return them encoded, in this order.

        Raises:
            DeliveryError: The store cannot be read.
        """
        payloads = []
        for name in sorted(self._store.state_names(_PREFIX))[:count]:
            payload = self._store.get_state(name)
            if payload is None:
                continue  # replaced by a pick
            effects.delete_state(name)
            payloads.append(payload)
        return payloads
