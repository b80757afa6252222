"""Budget of bytes a day and windows."""

import pytest

from sonarpost.extensions.satellite.policy import ByteBudget, Window

DAY_S = 86400.0


@pytest.mark.parametrize(
    ("text", "inside", "outside"),
    [("06:00-18:30", 12.0, 18.5), ("22:00-02:00", 23.5, 2.0), ("22:00-02:00", 1.5, 21.9), ("00:00-06:00", 0.0, 6.0)],
)
def test_window_contains_its_hours(text, inside, outside):
    window = Window.parse(text)
    assert window.contains(5 * DAY_S + inside * 3600)
    assert not window.contains(5 * DAY_S + outside * 3600)


@pytest.mark.parametrize("text", ["", "06:00", "06:00-06:00", "6-7", "24:00-25:00", "06:00-18:00-19:00"])
def test_invalid_window_is_refused(text):
    with pytest.raises(ValueError, match="HH:MM"):
        Window.parse(text)


def test_budget_holds_over_restarts_and_is_renewed_at_midnight():
    budget = ByteBudget(bytes_per_day=1000)
    now_s = 20_000 * DAY_S
    for _ in range(2):
        assert budget.allows(340, now_s)
        budget.charge(340, now_s)
    again = ByteBudget(bytes_per_day=1000)
    again.restore(budget.pack())
    assert again == budget
    assert again.allows(320, now_s)
    assert not again.allows(321, now_s + DAY_S - 1)
    again.refund(340)
    assert again.allows(660, now_s)
    assert again.allows(1000, now_s + DAY_S)
    again.charge(1000, now_s + DAY_S)
    # A clock that is set back must not renew it.
    assert not again.allows(1, now_s)
    assert (again.total_messages, again.total_bytes, again.used_today(now_s + 2 * DAY_S)) == (2, 1340, 0)


def test_closed_window_and_no_limit():
    budget = ByteBudget(windows=(Window.parse("06:00-07:00"),))
    assert not budget.allows(1, 5 * 3600)
    assert budget.allows(10**9, 6 * 3600)
