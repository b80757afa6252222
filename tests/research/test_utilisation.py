"""A vehicle that has data keeps the water busy, and still hears what the vessel reports."""

from __future__ import annotations

import pytest

from research.utilisation import BusySpec, run_busy
from sonarpost.errors import ConfigError


def test_at_rate_5_the_water_is_busy_and_every_report_is_heard() -> None:
    result = run_busy(BusySpec(rate=5, seconds=1200.0))
    assert result.busy >= 0.95
    assert result.frames_full > 0.99
    assert result.reports >= 6
    assert result.reports >= 0.8 * result.reports_sent


def test_without_pauses_nothing_but_the_turn_from_packet_to_packet_is_lost() -> None:
    result = run_busy(BusySpec(rate=1, rx_window_s=0.0, frame_loss=0.0, seconds=600.0))
    assert result.busy > 0.995
    assert result.reports == 0


def test_a_slow_serial_line_limits_rate_5() -> None:
    slow = run_busy(BusySpec(rate=5, serial_baud=19_200.0, rx_window_s=0.0, seconds=120.0))
    fast = run_busy(BusySpec(rate=5, serial_baud=115_200.0, rx_window_s=0.0, seconds=120.0))
    assert 0.5 < slow.busy < 0.7
    assert 0.85 < fast.busy < 0.95


@pytest.mark.parametrize("wrong", [{"rate": 7}, {"serial_baud": -1}, {"range_m": 0}, {"frame_loss": 1}, {"seconds": 1}])
def test_values_out_of_range_are_named(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        BusySpec(**wrong)
