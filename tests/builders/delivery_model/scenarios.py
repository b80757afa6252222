"""Configurations of the search, and rules that are removed one by one.

Two or three records in each queue are enough for the known defects: one record before and one after the fault. More
records only repeat the same steps under other numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from builders.delivery_model.machine import Record, World
from builders.delivery_model.rules import NEW, Rules

A1, A2, A3 = (Record(f"a{number}", "A") for number in range(1, 4))
B1 = Record("b1", "B")
INVALID = Record("invalid", "A", valid=False)
LARGE, LARGE_2 = Record("large-1", "A", chunks=2), Record("large-2", "A", chunks=2)
OLDER = Record("edition-1", "A", droppable=True)
JUNK = Record("junk", "H", valid=False)
OWN = Record("own", "H")
OPEN, OPEN_2 = Record("open-1", "H", chunks=2), Record("open-2", "H", chunks=2)


def crashes(rules: Rules) -> World:
    """One producer, two keys, an invalid record, two crashes."""
    return World(rules, ((A1, B1, INVALID),), crashes=2)


def drops(rules: Rules) -> World:
    """A record that a newer edition replaces, and a crash."""
    return World(rules, ((OLDER, A1, B1),), crashes=1)


def two_producers(rules: Rules) -> World:
    """Two producers with a common key, and a crash."""
    return World(rules, ((A1, A2), (Record("p1", "A"), Record("p2", "B"))), crashes=1)


def hostile(rules: Rules) -> World:
    """A peer that may write to another key of the same consumer."""
    return World(rules, ((A1, B1),), crashes=1, attacks=1, hostile_keys=("H",), hostile_records=(JUNK, OWN))


def hostile_with_origin(rules: Rules) -> World:
    """The same peer, which has learned the origin."""
    return replace(hostile(rules), origin_leaked=True)


def hostile_twice(rules: Rules) -> World:
    """The same peer with two queries."""
    return replace(hostile_with_origin(rules), attacks=2)


def shared_key(rules: Rules) -> World:
    """A hostile peer that may write to the producer's own key."""
    own, junk = Record("own", "A"), Record("junk", "A", valid=False)
    return World(rules, ((A1, A2),), attacks=1, hostile_keys=("A",), hostile_records=(junk, own))


def shared_key_with_origin(rules: Rules) -> World:
    """The same peer, which has learned the origin."""
    return replace(shared_key(rules), origin_leaked=True)


def restore(rules: Rules) -> World:
    """A producer's store is restored from a backup."""
    return World(rules, ((A1, A2, A3),), restores=1)


def restore_two_keys(rules: Rules) -> World:
    """A restore, with records of two keys in one queue."""
    return World(rules, ((A1, B1, A2),), restores=1)


def restore_large(rules: Rules) -> World:
    """A restore between the chunks of two records."""
    return World(rules, ((LARGE, LARGE_2),), restores=1)


def restore_and_crash(rules: Rules) -> World:
    """A restore and a crash."""
    return World(rules, ((A1, A2, A3),), restores=1, crashes=1)


def restore_twice(rules: Rules) -> World:
    """Two restores."""
    return World(rules, ((A1, A2, A3),), restores=2)


def restore_and_neighbour(rules: Rules) -> World:
    """A restore of either of two producers with a common key, one record each before and after."""
    return World(rules, ((A1, A2), (Record("p1", "A"),)), restores=1)


def hostile_and_restore(rules: Rules) -> World:
    """A restore while a peer attacks another key with the origin known."""
    return World(
        rules,
        ((A1, A2),),
        restores=1,
        attacks=1,
        hostile_keys=("H",),
        hostile_records=(JUNK, OWN),
        origin_leaked=True,
    )


def hostile_large(rules: Rules) -> World:
    """A peer with two keys that leaves records incomplete beside one of the producer."""
    return World(
        rules,
        ((LARGE,),),
        attacks=2,
        hostile_keys=("H1", "H2"),
        hostile_records=(OPEN, OPEN_2),
        hostile_large=True,
        max_partials=2,
    )


Scenario = Callable[[Rules], World]
SCENARIOS: tuple[Scenario, ...] = (
    crashes,
    drops,
    two_producers,
    hostile,
    hostile_with_origin,
    shared_key,
    restore,
    restore_two_keys,
    restore_large,
    hostile_and_restore,
    hostile_large,
)
LARGE_SCENARIOS: tuple[Scenario, ...] = (
    hostile_twice,
    restore_and_crash,
    restore_twice,
    restore_and_neighbour,
)
WITH_SHARED_ORIGIN = shared_key_with_origin
"""A peer that may write to the key and has the origin can cause a new origin (I6). All other invariants hold."""


@dataclass(frozen=True)
class Removal:
    """Rules that are removed, and the first violation that the search must find.

    Attributes:
        name: Name of the removal.
        changes: Changed fields of `Rules`.
        scenario: Configuration in which the violation is found.
        invariant: Name of the violated invariant.
    """

    name: str
    changes: Mapping[str, bool | int]
    scenario: Scenario
    invariant: str

    @property
    def world(self) -> World:
        """The configuration with the changed rules."""
        return self.scenario(replace(NEW, **self.changes))  # type: ignore[arg-type]


REMOVALS = (
    Removal("identity without digest", {"compare_digest": False}, restore, "I1"),
    Removal("settled counts as received", {"settled_prunes": False}, restore, "I1"),
    Removal("settled counts as received, shared key", {"settled_prunes": False}, shared_key_with_origin, "I1"),
    Removal("settled deletes all digests", {"keep": 0}, drops, "I2"),
    Removal("origin visible to watchers", {"secret_origin": False}, shared_key, "I6"),
    Removal("queued records get the new origin", {"origin_of_row": False}, restore, "I2"),
    Removal("age compared for earlier origins", {"current_origin_only": False}, restore, "I6"),
    Removal("age of a store not compared", {"detect_restore": False}, restore, "I5"),
    Removal("reused number not stated", {"state_reused": False}, restore, "I5"),
    Removal("oldest chunks deleted first", {"fair_chunks": False}, hostile_large, "I4"),
    Removal("each key counts as a writer", {"writer_of_prefix": False}, hostile_large, "I4"),
    Removal("assembled digest not checked", {"check_assembled": False}, shared_key_with_origin, "I1"),
    Removal("reply before the commit", {"commit_first": False}, crashes, "I1"),
    Removal("reply used by a later run", {"bind_replies": False}, restore, "I1"),
    # Rules that only protect together with another one: the search finds a violation without both.
    Removal(
        "window over all keys, key not validated",
        {"window_of_key": False, "validate_key": False},
        hostile_with_origin,
        "I1",
    ),
    Removal(
        "settled of a refused record counts as received",
        {"settled_prunes": False, "settled_after_acceptance": False, "window_of_key": False},
        hostile_with_origin,
        "I1",
    ),
    Removal(
        "refused numbers remembered without digest",
        {"forget_refused": False, "compare_digest": False, "window_of_key": False},
        hostile_with_origin,
        "I1",
    ),
    Removal(
        "chunks without digest, assembled digest not checked",
        {"chunks_of_digest": False, "check_assembled": False},
        restore_large,
        "I3",
    ),
)
DEPTH_RULES: Mapping[str, str] = {
    "window_of_key": "a record is valid only on its own key, and its identity has the digest",
    "settled_after_acceptance": "`settled` only permits to delete digests, and the newest ones stay",
    "forget_refused": "the refused identity has the digest of a record that stays invalid",
    "chunks_of_digest": "the digest of the assembled record is checked",
    "validate_key": "a window belongs to a key",
}
"""Rules that can be removed alone without a violation in the small configurations, and what protects then."""
