"""Exhaustive search of the delivery model: invariants of `docs/specifications/delivery.md`.

`python -m research.delivery_model` prints all configurations with the number of states.
"""

from dataclasses import fields, replace

import pytest

from research.delivery_model.rules import NEW, OLD, Rules
from research.delivery_model.scenarios import (
    DEPTH_RULES,
    HOSTILE,
    HOSTILE_WITH_ORIGIN,
    JUNK,
    LARGE_SCENARIOS,
    REMOVALS,
    RESTORE,
    RESTORE_LARGE,
    SCENARIOS,
    WITH_SHARED_ORIGIN,
)
from research.delivery_model.search import explore


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    "name", [*SCENARIOS, *(pytest.param(name, marks=pytest.mark.system) for name in LARGE_SCENARIOS)]
)
def test_all_states_satisfy_the_invariants(name):
    result = explore((SCENARIOS | LARGE_SCENARIOS)[name])
    assert not result.violation, str(result)


def test_peer_with_the_same_key_and_origin_cannot_suppress_records():
    result = explore(WITH_SHARED_ORIGIN, ("I1", "I2", "I3", "I4", "P1"))
    assert not result.violation, str(result)


@pytest.mark.parametrize(
    ("world", "changes", "lost", "steps"),
    [
        # A consumer with one window for all keys obeys an invalid record on key H; the record on key A is then lost.
        (HOSTILE, {}, "a1", {2: "hostile peer sends origin-1/", 3: "on key A, done_up_to 0: refused"}),
        # Refused numbers are not remembered here, so that only `done_up_to` of the refused query remains.
        (
            replace(HOSTILE, hostile_records=(JUNK,)),
            {"forget_refused": True},
            "a1",
            {2: "on key H, done_up_to", 3: "a1 on key A, done_up_to 0: stored"},
        ),
        (RESTORE, {}, "a2", {-2: "a2 on key A, done_up_to 0: stored"}),
    ],
    ids=["one window", "done_up_to of a refused query", "restore"],
)
def test_search_finds_the_loss_with_earlier_rules(world, changes, lost, steps):
    result = explore(replace(world, rules=replace(OLD, **changes)), "I1")
    assert result.violation == f"I1: record {lost} is lost"
    assert all(text in result.trace[number] for number, text in steps.items()), str(result)
    assert ("producer-1 is restored from its backup" in result.trace) == (world is RESTORE)


@pytest.mark.parametrize(
    "removal",
    [pytest.param(r, marks=pytest.mark.system if r.scenario is RESTORE else (), id=r.name) for r in REMOVALS],
)
def test_search_finds_a_violation_without_a_rule(removal):
    result = explore(removal.world, removal.invariant)
    assert result.violation.startswith(removal.invariant + ":"), str(result)
    assert result.trace


@pytest.mark.system
@pytest.mark.parametrize("rule", sorted(DEPTH_RULES))
@pytest.mark.parametrize(
    "world", [HOSTILE_WITH_ORIGIN, RESTORE_LARGE, RESTORE], ids=["hostile_with_origin", "restore_large", "restore"]
)
def test_other_rules_protect_when_a_rule_is_missing(rule, world):
    # New origins (I6) depend on the window; the other invariants must hold.
    result = explore(replace(world, rules=replace(NEW, **{rule: False})), ("I1", "I2", "I3", "I4"))
    assert not result.violation, str(result)


def test_each_rule_is_removed_in_a_test():
    removed = {name for removal in REMOVALS for name in removal.changes}
    assert removed | set(DEPTH_RULES) == {field.name for field in fields(Rules)}
