"""Which decision on a contact counts: withdrawals, overruling, disputes."""

import pytest
from builders.records import decision_record
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.review.decisions import review_result


def decision(decision_id, verdict, operator="anna", **fields):
    return decision_record(**{"decision_id": decision_id, "verdict": verdict, "operator": operator, **fields})


def withdrawal(decision_id, of, verdict="unsure", operator="anna"):
    return decision(decision_id, verdict, operator, withdraws=of)


def state(*decisions):
    found = review_result(decisions)
    return found.state, None if found.counting is None else found.counting.decision_id


def test_no_decision_is_unreviewed():
    assert state() == ("unreviewed", None)
    assert not review_result(()).is_withdrawn


@pytest.mark.parametrize("verdict", ["mine_like", "not_mine_like", "unsure"])
def test_latest_decision_of_one_operator_counts(verdict):
    assert state(decision("d-1", "mine_like"), decision("d-2", verdict)) == (verdict, "d-2")


def test_withdrawal_of_the_only_decision_gives_unreviewed():
    found = review_result((decision("d-1", "mine_like"), withdrawal("d-2", "d-1")))
    assert (found.state, found.counting, found.is_withdrawn) == ("unreviewed", None, True)
    assert (found.withdrawn, found.withdrawals) == (frozenset({"d-1"}), frozenset({"d-2"}))


def test_withdrawal_restores_the_decision_before():
    decisions = decision("d-1", "mine_like"), decision("d-2", "unsure"), withdrawal("d-3", "d-2", "mine_like")
    # The restored decision counts, not the record that repeats its verdict.
    assert state(*decisions) == ("mine_like", "d-1")


def test_decision_after_a_withdrawal_counts():
    decisions = decision("d-1", "mine_like"), withdrawal("d-2", "d-1"), decision("d-3", "not_mine_like")
    assert state(*decisions) == ("not_mine_like", "d-3")
    assert not review_result(decisions).is_withdrawn


def test_withdrawal_before_its_decision_arrives_does_not_count():
    early = withdrawal("d-2", "d-1")
    assert state(early) == ("unreviewed", None)
    assert state(early, decision("d-1", "mine_like")) == ("unreviewed", None)


def test_mine_like_against_not_mine_like_is_disputed_and_mine_like_counts():
    decisions = decision("d-1", "mine_like"), decision("d-2", "not_mine_like", "ben")
    assert state(*decisions) == state(*reversed(decisions)) == ("disputed", "d-1")
    assert [d.decision_id for d in review_result(decisions).standing] == ["d-1", "d-2"]


def test_unsure_disputes_mine_like_only():
    assert state(decision("d-1", "mine_like"), decision("d-2", "unsure", "ben")) == ("disputed", "d-1")
    assert state(decision("d-1", "not_mine_like"), decision("d-2", "unsure", "ben")) == ("unsure", "d-2")


def test_dispute_ends_when_an_operator_agrees_or_withdraws():
    first, second = decision("d-1", "mine_like"), decision("d-2", "not_mine_like", "ben")
    assert state(first, second, decision("d-3", "not_mine_like")) == ("not_mine_like", "d-3")
    assert state(first, second, withdrawal("d-3", "d-2", operator="ben")) == ("mine_like", "d-1")


def test_overruling_decision_ends_a_dispute_and_its_withdrawal_restores_it():
    first, second = decision("d-1", "mine_like"), decision("d-2", "not_mine_like", "ben")
    third = decision("d-3", "not_mine_like", "cora", overrules=("d-1", "d-9"))
    found = review_result((first, second, third))
    assert (found.state, found.counting) == ("not_mine_like", third)
    assert state(first, second, third, withdrawal("d-4", "d-3", operator="cora")) == ("disputed", "d-1")


def test_overruled_operator_can_decide_again():
    first = decision("d-1", "mine_like")
    second = decision("d-2", "not_mine_like", "ben", overrules=("d-1",))
    assert state(first, second, decision("d-3", "mine_like")) == ("disputed", "d-3")


@given(
    st.lists(
        st.builds(
            decision,
            st.sampled_from([f"d-{n}" for n in range(8)]),
            st.sampled_from(["mine_like", "not_mine_like", "unsure"]),
            st.sampled_from(["anna", "ben", "cora"]),
            withdraws=st.none() | st.sampled_from([f"d-{n}" for n in range(8)]),
            overrules=st.lists(st.sampled_from([f"d-{n}" for n in range(8)]), max_size=3).map(tuple),
        ),
        max_size=8,
        unique_by=lambda d: d.decision_id,
    )
)
def test_any_decisions_have_one_state(decisions):
    found = review_result(decisions)
    assert (found.counting is None) == (found.state == "unreviewed") == (not found.standing)
    assert len({d.operator for d in found.standing}) == len(found.standing)
    if found.counting is not None:
        assert found.counting in found.standing
        assert found.state in (found.counting.verdict, "disputed")
        assert found.state != "disputed" or found.counting.verdict == "mine_like"
