"""Contacts that wait for room on the way to the water, on the disk, the most confident first."""

from __future__ import annotations

import bisect
import threading
from collections.abc import Callable, Sequence

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.messages import Snippet

_PREFIX = "pool:"
_GREATEST_CONFIDENCE = 2.0
_STEPS = 1_000_000


class ContactPool:
    """Snippets in the store's state, each under a name that sorts by confidence, then by age.

    A snippet whose contact has no confidence comes last. `add` and `release` write into effects; what they say holds
    when `committed` was called after these were. One thread writes at a time: take `lock` around both.
    """

    def __init__(self, store: Store) -> None:
        self.lock = threading.Lock()
        self._store = store
        self._names = sorted(store.state_names(_PREFIX))
        self._next = 1 + max((int(name.rpartition(":")[2]) for name in self._names), default=0)

    def __len__(self) -> int:
        return len(self._names)

    def add(self, effects: UnitOfWork, payloads: Sequence[bytes]) -> Callable[[], None]:
        """Keep snippets, given as their records' bytes; return what is to be called when the effects are committed."""
        names = []
        for payload in payloads:
            confidence = wire.decode(Snippet, payload, "pool").contact.atd_confidence
            rank = round((_GREATEST_CONFIDENCE - (confidence or 0.0)) * _STEPS) + (confidence is None)
            names.append(f"{_PREFIX}{rank:08d}:{self._next:015d}")
            self._next += 1
            effects.put_state(names[-1], payload)

        def committed() -> None:
            for name in names:
                bisect.insort(self._names, name)

        return committed

    def release(
        self, effects: UnitOfWork, most: int, send: Callable[[UnitOfWork, bytes], None]
    ) -> tuple[int, Callable[[], None]]:
        """Let the most confident go; return how many, and what is to be called when the effects are committed.

        Args:
            effects: Takes them out of the store.
            most: At most so many.
            send: Adds to the effects that a payload is owed.

        Raises:
            HandoffError: The store cannot be read.
        """
        names = self._names[:most]
        for name in names:
            payload = self._store.get_state(name)
            assert payload is not None, f"{name} is in no other hands"
            send(effects, payload)
            effects.delete_state(name)

        def committed() -> None:
            del self._names[: len(names)]

        return len(names), committed
