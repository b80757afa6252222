"""State of an endpoint of the acoustic link in the store of its service: restored, quarantined, saved."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Final, Generic, Protocol, TypeVar

from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import BadInputError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.state import Parts, SavedParts

_COUNTER_LIMIT: Final = "counter-limit/"


class LinkEndpoint(Protocol):
    """An end of the acoustic link."""

    def parts(self) -> dict[str, bytes]:
        """Return the state to save, see `sonarpost.link.state`."""

    def restore(self, parts: Parts) -> Mapping[str, BadInputError]:
        """Replace the state of a new endpoint by saved parts; return why parts were skipped."""


E = TypeVar("E", bound=LinkEndpoint)


class SavedEndpoint(Generic[E]):
    """An endpoint and its committed state. Several threads change it, each within `step`.

    A step ends with the commit of `changes`. If a step fails, the next one first restores the state that was committed
    last.

    Attributes:
        lock: Lock of the endpoint, which a step holds; it can be acquired again by its holder.
        current: The endpoint; after a failed step another object.

    Args:
        store: Holds the state.
        prefix: The names of the saved parts begin with it.
        create: Returns an endpoint without state.
    """

    def __init__(self, store: Store, prefix: str, create: Callable[[], E]) -> None:
        self._store = store
        self._prefix = prefix
        self._create = create
        self.lock = threading.RLock()
        self._is_stale = True
        self.current = create()
        self._saved = SavedParts({})

    @contextmanager
    def step(self) -> Iterator[E]:
        """Context manager for changes: locks the endpoint, and restores it if the last step failed.

        Raises:
            DeliveryError: The state cannot be read, or a part that cannot be used cannot be quarantined.
        """
        with self.lock:
            if self._is_stale:
                self._restore()
                self._is_stale = False
            try:
                yield self.current
            except BaseException:
                self._is_stale = True
                raise

    def _restore(self) -> None:
        self.current = self._create()
        parts = self._store.states(self._prefix)
        errors = self.current.restore(parts)
        if errors:
            with self._store.transaction() as tx:
                for name, reason in errors.items():
                    tx.discard_state(self._prefix + name, parts.get(name, b""), str(reason))
        self._saved = SavedParts(parts)

    def changes(self) -> UnitOfWork:
        """Return the changed parts of the state, to commit in this step."""
        parts, effects = self.current.parts(), UnitOfWork()
        effects.put_states(self._prefix, self._saved.changes(parts))
        self._saved.commit(parts)
        return effects


def stored_authenticator(store: Store, key: AcousticKey, address: int, sends: Direction) -> FrameAuthenticator:
    """Return an authenticator that uses no counter that an earlier process can have used.

    The limit of the counters belongs to the key: another key starts at 0, and the old one continues when it is used
    again.

    Args:
        store: Holds the limit.
        key: The acoustic key.
        address: Modem address of this station.
        sends: Direction of its frames.
    """
    limit = int(store.get_state(_COUNTER_LIMIT + key.fingerprint) or b"0")
    return FrameAuthenticator(key, address, sends, first_counter=limit)


def reserve_counters(store: Store, authenticator: FrameAuthenticator | None) -> None:
    """Commit the limit of the authentication counters before they are used.

    Raises:
        DeliveryError: The store cannot be written.
    """
    if authenticator is None or (limit := authenticator.requested_limit) is None:
        return
    with store.transaction() as tx:
        tx.put_state(_COUNTER_LIMIT + authenticator.fingerprint, str(limit).encode())
    authenticator.grant(limit)
