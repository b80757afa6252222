"""Fixture: a small survey."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey


@pytest.fixture
def small_survey() -> Callable[..., Survey]:
    """Return a function that creates a survey of a few pings with different samples on both sides."""

    def create(dtype: type = np.uint8, pings: int = 5, samples: int = 40) -> Survey:
        rng = np.random.default_rng(3)
        full_scale = np.iinfo(dtype).max
        ping_list = []
        for row in range(pings):
            channels = tuple(
                ChannelPing(side, rng.integers(0, full_scale, samples, dtype=dtype, endpoint=True), 25.0, 600_000.0)
                for side in Side
            )
            ping_list.append(
                Ping(
                    number=row + 10,
                    time_utc_s=1_378_847_588.13 + row * 0.37,
                    channels=channels,
                    lat_deg=48.44545 + row * 1e-6,
                    lon_deg=-68.827935,
                    heading_deg=354.5,
                    altitude_m=6.25,
                    depth_m=14.5,
                    speed_mps=1.03125,
                    pitch_deg=-2.5,
                    roll_deg=3.75,
                )
            )
        return Survey(Path("made.xtf"), "HDS", "made", tuple(ping_list))

    return create
