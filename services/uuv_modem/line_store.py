"""What of the v1 link outlives the process: only what has changed is written, all of it in one transaction."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Final

import msgpack

from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import Transaction

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
        self._written: dict[str, bytes] = {}
        self._arrivals = max((_number(name) for name in store.state_names(ARRIVAL)), default=0)

    def load(self) -> tuple[dict[str, Mapping[str, object]], dict[str, bytes]]:
        """Return the parts that were saved, and the bytes of those that are no map."""
        parts: dict[str, Mapping[str, object]] = {}
        unreadable: dict[str, bytes] = {}
        for full_name in self._store.state_names(_PREFIX):
            data = self._store.get_state(full_name) or b""
            name = full_name.removeprefix(_PREFIX)
            self._written[name] = _digest(data)
            try:
                part = msgpack.unpackb(data, strict_map_key=False)
            except (ValueError, msgpack.exceptions.UnpackException):
                part = None
            if isinstance(part, dict):
                parts[name] = part
            else:
                unreadable[name] = data
        return parts, unreadable

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

    def write(self, tx: Transaction, parts: Mapping[str, Mapping[str, object]]) -> dict[str, bytes]:
        """Write the parts that differ from what is on the disk; return what `wrote` wants once it is committed."""
        digests: dict[str, bytes] = {}
        for name, part in parts.items():
            data = msgpack.packb(part)
            digests[name] = _digest(data)
            if self._written.get(name) != digests[name]:
                tx.put_state(_PREFIX + name, data)
        for name in self._written.keys() - digests.keys():
            tx.delete_state(_PREFIX + name)
        return digests

    def wrote(self, digests: dict[str, bytes]) -> None:
        """Note that the transaction of `write` is committed."""
        self._written = digests

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


def _digest(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()
