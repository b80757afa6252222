"""Exhaustive search of the delivery model: invariants of `docs/specifications/delivery.md`.

`PYTHONPATH=tests python -m builders.delivery_model` prints all configurations with the number of states.
"""

from dataclasses import fields, replace

import pytest
from builders.delivery_model.rules import NEW, OLD, Rules
from builders.delivery_model.scenarios import (
    DEPTH_RULES,
    JUNK,
    LARGE_SCENARIOS,
    REMOVALS,
    SCENARIOS,
    WITH_SHARED_ORIGIN,
    hostile,
    hostile_with_origin,
    restore,
    restore_large,
)
from builders.delivery_model.search import explore


@pytest.mark.parametrize("scenario", SCENARIOS, ids=lambda scenario: scenario.__name__)
def test_all_states_satisfy_the_invariants(scenario):
    result = explore(scenario(NEW))
    print(f"{scenario.__name__}: {result}")
    assert not result.violation, str(result)


@pytest.mark.system
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("scenario", LARGE_SCENARIOS, ids=lambda scenario: scenario.__name__)
def test_all_states_of_larger_configurations_satisfy_the_invariants(scenario):
    result = explore(scenario(NEW))
    print(f"{scenario.__name__}: {result}")
    assert not result.violation, str(result)


def test_peer_with_the_same_key_and_origin_cannot_suppress_records():
    result = explore(WITH_SHARED_ORIGIN(NEW), ("I1", "I2", "I3", "I4", "P1"))
    assert not result.violation, str(result)


def test_search_finds_the_loss_by_a_peer_that_writes_another_key():
    # A consumer with one window for all keys obeys an invalid record on key H; the record on key A is then lost.
    result = explore(hostile(OLD), "I1")
    print(f"one window for all keys: {result}")
    assert result.violation == "I1: record a1 is lost"
    assert "hostile peer sends origin-1/" in result.trace[2]
    assert "on key A, settled 0: refused" in result.trace[3]
    assert len(result.trace) == 5


def test_search_finds_the_silent_loss_by_a_settled_number_of_another_key():
    # Refused numbers are not remembered here, so that only `settled` of the refused query remains.
    world = replace(hostile(replace(OLD, forget_refused=True)), hostile_records=(JUNK,))
    result = explore(world, "I1")
    print(f"settled of a refused query: {result}")
    assert result.violation == "I1: record a1 is lost"
    assert "on key H, settled" in result.trace[2]
    assert result.trace[2].endswith(": refused")
    assert result.trace[3].endswith("a1 on key A, settled 0: stored")


def test_search_finds_the_loss_after_a_restore_from_a_backup():
    result = explore(restore(OLD), "I1")
    print(f"identity without digest: {result}")
    assert result.violation == "I1: record a2 is lost"
    assert "producer-1 is restored from its backup" in result.trace
    assert result.trace[-2].endswith("a2 on key A, settled 0: stored")


@pytest.mark.parametrize("removal", REMOVALS, ids=lambda removal: removal.name)
def test_search_finds_a_violation_without_a_rule(removal):
    result = explore(removal.world, removal.invariant)
    print(f"{removal.name}: {result}")
    assert result.violation.startswith(removal.invariant + ":")
    assert result.trace


@pytest.mark.parametrize("rule", sorted(DEPTH_RULES))
@pytest.mark.parametrize(
    "scenario",
    [hostile_with_origin, restore_large, pytest.param(restore, marks=pytest.mark.system)],
    ids=lambda scenario: scenario.__name__,
)
def test_other_rules_protect_when_a_rule_is_missing(rule, scenario):
    # New origins (I6) depend on the window; the other invariants must hold.
    result = explore(scenario(replace(NEW, **{rule: False})), ("I1", "I2", "I3", "I4"))
    assert not result.violation, str(result)


def test_each_rule_is_removed_in_a_test():
    removed = {name for removal in REMOVALS for name in removal.changes}
    assert removed | set(DEPTH_RULES) == {field.name for field in fields(Rules)}
