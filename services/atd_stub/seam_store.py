"""The ends of the latest files, one for each sonar, on the disk."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.logs import kv
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub.seam import Seam, pack, unpack

log = logging.getLogger(__name__)


_PREFIX = "seam:"
MOST_SONARS = 8


class SeamStore:
    """Keeps seams in the store's state and in memory; `committed` makes what was written since the last call hold.

    For one thread.
    """

    def __init__(self, store: Store) -> None:
        self._seams: dict[str, Seam] = {}
        for name in store.state_names(_PREFIX):
            packed = store.get_state(name)
            assert packed is not None
            try:
                self._seams[name] = unpack(packed)
            except ValueError as error:
                # It stays for the version that wrote it.
                log.warning("The end of a file is left out", extra=kv(reason=str(error)))
        self._next = dict(self._seams)
        self.held = self._count()

    def all(self) -> Mapping[str, Seam]:
        """Return the seams by sonar."""
        return {seam.sonar_id: seam for seam in self._seams.values()}

    def keep(self, effects: UnitOfWork, seam: Seam | None, *, joined: bool) -> tuple[Snippet, ...]:
        """Keep a file's end in place of the one before it.

        Args:
            effects: Takes it to the disk.
            seam: The end, None where none is kept.
            joined: The file went on at the end before it, so what was held there has been dealt with.

        Returns:
            What was held where the file did not go on.
        """
        self._next = dict(self._seams)
        if seam is None:
            return ()
        name = _PREFIX + seam.sonar_id
        before = self._next.pop(name, None)
        gone = [] if before is None or joined else [before]
        self._next[name] = seam
        effects.put_state(name, pack(seam))
        while len(self._next) > MOST_SONARS:
            oldest = next(iter(self._next))
            gone.append(self._next.pop(oldest))
            effects.delete_state(oldest)
        return tuple(snippet for each in gone for snippet in _held(each))

    def end(self, effects: UnitOfWork, now_utc_s: float, wait_s: float) -> tuple[Snippet, ...]:
        """Return what has waited long enough; it is held no more. A clock that was set back does not prolong that."""
        self._next = dict(self._seams)
        freed: list[Snippet] = []
        for name, seam in self._seams.items():
            if seam.held and not now_utc_s < seam.until_utc_s <= now_utc_s + wait_s:
                freed += _held(seam)
                self._next[name] = seam.let_go()
                effects.put_state(name, pack(self._next[name]))
        return tuple(freed)

    def committed(self) -> None:
        """Let what was written hold: it is on the disk."""
        self._seams = self._next
        self.held = self._count()

    def _count(self) -> int:
        return sum(len(seam.held) for seam in self._seams.values())


def _held(seam: Seam) -> tuple[Snippet, ...]:
    return tuple(wire.decode(Snippet, payload, "seam") for payload in seam.held)
