"""Declared limits, and the order in which sources are served."""

import pytest

from sonarpost import limits
from sonarpost.limits import DECLARED, Turns, limit


def test_declared_limit_is_listed_with_its_module_once():
    texts = {"surface": "test", "source": "client", "resource": "requests", "at_limit": "refused"}
    assert limit(3, "requests", "shares", **texts) == 3
    try:
        assert DECLARED[__name__, "test", "requests"].value == 3
        with pytest.raises(ValueError, match="declared twice"):
            limit(4, "requests", "shares", **texts)
    finally:
        del DECLARED[__name__, "test", "requests"]


def test_sources_are_served_in_turn_in_the_order_of_their_items():
    turns = Turns()
    assert turns.pick({"a": ["a1", "a2", "a3", "a4"], "b": ["b1"]}, 3) == ["a1", "b1", "a2"]
    assert turns.pick({"a": ["a3", "a4"], "c": ["c1"]}, 2) == ["c1", "a3"]
    assert turns.pick({"a": ["a4"]}, 5) == ["a4"]
    assert turns.pick({}, 5) == []


def test_sources_that_pause_after_each_turn_do_not_delay_another_one():
    turns = Turns()
    assert turns.pick({"b": ["b"]}, 1) == ["b"]
    assert turns.pick({"a1": ["a1"], "b": ["b"]}, 1) == ["a1"]
    assert turns.pick({"a2": ["a2"], "b": ["b"]}, 1) == ["a2"]
    assert turns.pick({"a1": ["a1"], "b": ["b"]}, 1) == ["b"]


def test_number_of_remembered_sources_is_limited(monkeypatch):
    monkeypatch.setattr(limits, "MAX_SOURCES", 3)
    turns = Turns()
    for number in range(10):
        turns.pick({f"source-{number}": [number]}, 1)
    assert list(turns._served) == ["source-7", "source-8", "source-9"]
