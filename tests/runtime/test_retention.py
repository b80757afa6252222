"""Time that retention uses: the start and a step of the wall clock take effect after a day."""

import pytest

from sonarpost.archive.retention import EARLIEST_UTC_S
from sonarpost.runtime.retention import FOLLOW_AFTER_S, SteadyTime

START_UTC_S = 1_800_000_000.0
YEAR_S = 365 * 86400.0


class Clocks:
    """Wall clock and monotonic clock of a test."""

    def __init__(self, monkeypatch):
        self.wall_s, self.steady_s = START_UTC_S, 100.0
        monkeypatch.setattr("sonarpost.runtime.retention.time.time", lambda: self.wall_s)
        monkeypatch.setattr("sonarpost.runtime.retention.time.monotonic", lambda: self.steady_s)

    def run(self, seconds):
        self.wall_s += seconds
        self.steady_s += seconds


@pytest.fixture
def clocks(monkeypatch):
    return Clocks(monkeypatch)


@pytest.fixture
def steady(clocks):
    """The time of a service that has run for a day, until `START_UTC_S`."""
    clocks.wall_s -= FOLLOW_AFTER_S
    steady = SteadyTime()
    clocks.run(FOLLOW_AFTER_S)
    assert steady.now_utc_s() == START_UTC_S
    return steady


def test_start_takes_effect_after_a_day(clocks, caplog):
    clocks.wall_s += YEAR_S
    steady = SteadyTime()
    for _ in range(24):
        assert steady.now_utc_s() < EARLIEST_UTC_S
        clocks.run(FOLLOW_AFTER_S / 24)
    assert steady.now_utc_s() == START_UTC_S + YEAR_S + FOLLOW_AFTER_S
    assert not caplog.records


def test_time_follows_the_wall_clock_and_its_small_corrections(clocks, steady):
    clocks.run(1000.0)
    clocks.wall_s += 30.0
    assert steady.now_utc_s() == START_UTC_S + 1030.0


def test_clock_that_is_set_forward_takes_effect_after_a_day(clocks, steady, caplog):
    clocks.wall_s += YEAR_S
    assert steady.now_utc_s() == START_UTC_S
    clocks.run(FOLLOW_AFTER_S - 60.0)
    assert steady.now_utc_s() == START_UTC_S + FOLLOW_AFTER_S - 60.0
    clocks.run(60.0)
    assert steady.now_utc_s() == START_UTC_S + YEAR_S + FOLLOW_AFTER_S
    assert len(caplog.records) == 1
    assert "Clock was set" in caplog.text


def test_clock_that_is_set_back_soon_changes_nothing(clocks, steady):
    clocks.wall_s += YEAR_S
    assert steady.now_utc_s() == START_UTC_S
    clocks.wall_s -= YEAR_S
    clocks.run(10.0)
    assert steady.now_utc_s() == START_UTC_S + 10.0


def test_earlier_time_is_used_at_once(clocks, steady):
    clocks.wall_s -= YEAR_S
    assert steady.now_utc_s() == START_UTC_S - YEAR_S
