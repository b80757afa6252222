"""Score of operators: Pd, false alarms, intervals, groups by received bytes."""

import pytest
from scipy.stats import binomtest

from sonarpost.services.console.store.truth import score, score_by_bytes, wilson_share


def decision(verdict, *, is_mine_like, received=100, shown_s=4.0):
    return {"verdict": verdict, "is_mine_like": is_mine_like, "bytes_received": received, "shown_s": shown_s}


@pytest.mark.parametrize(("count", "total"), [(0, 1), (1, 1), (0, 40), (18, 20), (20, 20), (7, 300)])
def test_interval_is_that_of_scipy(count, total):
    expected = binomtest(count, total).proportion_ci(0.95, method="wilson")
    found = wilson_share(count, total)
    assert (found["low"], found["high"]) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_share_without_a_case_is_unknown():
    assert wilson_share(0, 0)["share"] is None


def test_detections_and_false_alarms_are_counted():
    found = score(
        [
            decision("mine_like", is_mine_like=True),
            decision("not_mine_like", is_mine_like=True, shown_s=8.0),
            decision("unsure", is_mine_like=True, shown_s=None),
            decision("mine_like", is_mine_like=False, received=300),
            decision("not_mine_like", is_mine_like=False),
        ]
    )
    assert (found["detected"]["count"], found["detected"]["total"]) == (1, 3)
    assert (found["false_alarms"]["count"], found["false_alarms"]["total"]) == (1, 2)
    assert [found[name] for name in ("decided", "unsure", "median_shown_s", "median_bytes")] == [5, 1, 4.0, 100]


def test_groups_by_received_bytes_have_inclusive_upper_limits():
    decisions = [decision("mine_like", is_mine_like=True, received=size) for size in (1, 32, 33, 512, 513, 9000)]
    groups = {(one["above_bytes"], one["up_to_bytes"]): one["decided"] for one in score_by_bytes(decisions)}
    assert groups == {(0, 32): 2, (32, 64): 1, (256, 512): 1, (512, None): 2}
