"""Configurations of the search, and rules that are removed one by one.

Two or three records in each queue are enough for the known defects: one record before and one after the fault. More
records only repeat the same steps under other numbers.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

from research.delivery_model.machine import Record, World
from research.delivery_model.rules import NEW

A1, A2, A3 = (Record(f"a{number}", "A") for number in range(1, 4))
B1 = Record("b1", "B")
INVALID = Record("invalid", "A", valid=False)
LARGE, LARGE_2 = Record("large-1", "A", chunks=2), Record("large-2", "A", chunks=2)
OLDER = Record("edition-1", "A", droppable=True)
JUNK = Record("junk", "H", valid=False)
OWN = Record("own", "H")
OPEN, OPEN_2 = Record("open-1", "H", chunks=2), Record("open-2", "H", chunks=2)


CRASHES = World(NEW, ((A1, B1, INVALID),), crashes=2)
"""One producer, two keys, an invalid record, two crashes."""
DROPS = World(NEW, ((OLDER, A1, B1),), crashes=1)
"""A record that a newer edition replaces, and a crash."""
TWO_PRODUCERS = World(NEW, ((A1, A2), (Record("p1", "A"), Record("p2", "B"))), crashes=1)
"""Two producers with a common key, and a crash."""
HOSTILE = World(NEW, ((A1, B1),), crashes=1, attacks=1, hostile_keys=("H",), hostile_records=(JUNK, OWN))
"""A peer that may write to another key of the same consumer."""
HOSTILE_WITH_ORIGIN = replace(HOSTILE, origin_leaked=True)
"""The same peer, which has learned the origin."""
SHARED_KEY = World(
    NEW,
    ((A1, A2),),
    attacks=1,
    hostile_keys=("A",),
    hostile_records=(Record("junk", "A", valid=False), Record("own", "A")),
)
"""A hostile peer that may write to the producer's own key."""
WITH_SHARED_ORIGIN = replace(SHARED_KEY, origin_leaked=True)
"""A peer that may write to the key and has the origin can cause a new origin (I6). All other invariants hold."""
RESTORE = World(NEW, ((A1, A2, A3),), restores=1)
"""A producer's store is restored from a backup."""
RESTORE_LARGE = World(NEW, ((LARGE, LARGE_2),), restores=1)
"""A restore between the chunks of two records."""
HOSTILE_AND_RESTORE = replace(HOSTILE_WITH_ORIGIN, queues=((A1, A2),), crashes=0, restores=1)
"""A restore while a peer attacks another key with the origin known."""
HOSTILE_LARGE = World(
    NEW,
    ((LARGE,),),
    attacks=2,
    hostile_keys=("H1", "H2"),
    hostile_records=(OPEN, OPEN_2),
    hostile_large=True,
    max_partials=2,
)
"""A peer with two keys that leaves records incomplete beside one of the producer."""

SCENARIOS = {
    "crashes": CRASHES,
    "hostile": HOSTILE,
    "hostile_with_origin": HOSTILE_WITH_ORIGIN,
    "shared_key": SHARED_KEY,
    "restore_large": RESTORE_LARGE,
    "hostile_large": HOSTILE_LARGE,
}
LARGE_SCENARIOS = {
    "drops": DROPS,
    "two_producers": TWO_PRODUCERS,
    "restore": RESTORE,
    # A restore, with records of two keys in one queue.
    "restore_two_keys": replace(RESTORE, queues=((A1, B1, A2),)),
    "hostile_and_restore": HOSTILE_AND_RESTORE,
    "hostile_twice": replace(HOSTILE_WITH_ORIGIN, attacks=2),
    "restore_and_crash": replace(RESTORE, crashes=1),
    "restore_twice": replace(RESTORE, restores=2),
    # A restore of either of two producers with a common key, one record each before and after.
    "restore_and_neighbour": World(NEW, ((A1, A2), (Record("p1", "A"),)), restores=1),
}


class Removal(NamedTuple):
    """Rules that are removed from a configuration, and the first violation that the search must find."""

    name: str
    changes: Mapping[str, bool | int]
    scenario: World
    invariant: str

    @property
    def world(self) -> World:
        """The configuration with the changed rules."""
        return replace(self.scenario, rules=replace(NEW, **self.changes))  # type: ignore[arg-type]


REMOVALS = (
    Removal("identity without digest", {"compare_digest": False}, RESTORE, "I1"),
    Removal("done_up_to counts as received", {"done_up_to_prunes": False}, RESTORE, "I1"),
    Removal("done_up_to counts as received, shared key", {"done_up_to_prunes": False}, WITH_SHARED_ORIGIN, "I1"),
    Removal("done_up_to deletes all digests", {"keep": 0}, DROPS, "I2"),
    Removal("origin visible to watchers", {"secret_origin": False}, SHARED_KEY, "I6"),
    Removal("queued records get the new origin", {"origin_of_row": False}, RESTORE, "I2"),
    Removal("age compared for earlier origins", {"current_origin_only": False}, RESTORE, "I6"),
    Removal("age of a store not compared", {"detect_restore": False}, RESTORE, "I5"),
    Removal("reused number not stated", {"state_reused": False}, RESTORE, "I5"),
    Removal("oldest chunks deleted first", {"fair_chunks": False}, HOSTILE_LARGE, "I4"),
    Removal("each key counts as a writer", {"writer_of_prefix": False}, HOSTILE_LARGE, "I4"),
    Removal("assembled digest not checked", {"check_assembled": False}, WITH_SHARED_ORIGIN, "I1"),
    Removal("reply before the commit", {"commit_first": False}, CRASHES, "I1"),
    Removal("reply used by a later run", {"bind_replies": False}, RESTORE, "I1"),
    # Rules that only protect together with another one: the search finds a violation without both.
    Removal(
        "window over all keys, key not validated",
        {"window_of_key": False, "validate_key": False},
        HOSTILE_WITH_ORIGIN,
        "I1",
    ),
    Removal(
        "done_up_to of a refused record counts as received",
        {"done_up_to_prunes": False, "done_up_to_after_acceptance": False, "window_of_key": False},
        HOSTILE_WITH_ORIGIN,
        "I1",
    ),
    Removal(
        "refused numbers remembered without digest",
        {"forget_refused": False, "compare_digest": False, "window_of_key": False},
        HOSTILE_WITH_ORIGIN,
        "I1",
    ),
    Removal(
        "chunks without digest, assembled digest not checked",
        {"chunks_of_digest": False, "check_assembled": False},
        RESTORE_LARGE,
        "I3",
    ),
)
DEPTH_RULES: Mapping[str, str] = {
    "window_of_key": "a record is valid only on its own key, and its identity has the digest",
    "done_up_to_after_acceptance": "`done_up_to` only permits to delete digests, and the newest ones stay",
    "forget_refused": "the refused identity has the digest of a record that stays invalid",
    "chunks_of_digest": "the digest of the assembled record is checked",
    "validate_key": "a window belongs to a key",
}
"""Rules that can be removed alone without a violation in the small configurations, and what protects then."""
