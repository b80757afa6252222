"""Time scale of the channel emulator."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.simulation.channel.emulator import TimeScale


@given(st.floats(0.01, 1000.0), st.floats(0.0, 1e6), st.floats(0.0, 1e4))
def test_time_scale(scale: float, started_s: float, real_s: float):
    clock = TimeScale(scale, started_s)
    simulated_s = clock.simulated_s(started_s + real_s)
    assert simulated_s == pytest.approx(real_s * scale, rel=1e-6, abs=1e-6 * scale)
    assert started_s + clock.wait_s(simulated_s, started_s) == pytest.approx(started_s + real_s)
    assert clock.wait_s(simulated_s - 1, started_s + real_s + 1) == 0.0


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_time_scale_must_be_positive(scale: float):
    with pytest.raises(ValueError, match="time scale"):
        TimeScale(scale)
