"""Survey of a seabed of speckle with rectangular highlights and shadows; independent of the simulator."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

PINGS, SAMPLES, RANGE_M, ALTITUDE_M, SPEED_MPS, RATE_HZ = 200, 512, 20.0, 3.0, 1.0, 10.0


@dataclass(frozen=True)
class Box:
    """An object: a highlight centred on (`ping`, `sample`), and its shadow on the side away from the vehicle."""

    side: Side = Side.PORT
    ping: int = 100
    sample: int = 250
    pings: int = 8
    samples: int = 12
    shadow_samples: int = 30
    highlight: float = 5.0
    shadow: float = 0.05
    shadow_first: bool = False


def _image(rng: np.random.Generator, boxes: list[Box]) -> np.ndarray:
    mean = np.full((PINGS, SAMPLES), 1.0)
    for b in boxes:
        rows = slice(b.ping - b.pings // 2, b.ping - b.pings // 2 + b.pings)
        left = b.sample - b.samples // 2
        mean[rows, left : left + b.samples] = b.highlight
        start = left - b.shadow_samples if b.shadow_first else left + b.samples
        mean[rows, start : start + b.shadow_samples] = b.shadow
    ranges = (np.arange(SAMPLES) + 0.5) * RANGE_M / SAMPLES
    mean *= 1.0 / (1.0 + ranges / 8.0)
    mean[:, ranges < ALTITUDE_M] = 0.004
    return mean * rng.rayleigh(0.8, mean.shape) * 4000


@pytest.fixture(scope="session")
def make_survey() -> Callable[..., Survey]:
    """Return a function that creates a survey of objects, each given by fields of `Box`."""

    def create(
        *objects: dict,
        seed: int = 1,
        navigation: bool = True,
        altitude: bool = True,
        sides: tuple[Side, ...] = (Side.PORT, Side.STARBOARD),
        dtype: type = np.uint16,
        scale: float = 1.0,
    ) -> Survey:
        boxes = [Box(**fields) for fields in objects]
        rng = np.random.default_rng(seed)
        full_scale = np.iinfo(dtype).max
        images = {
            side: np.clip(_image(rng, [b for b in boxes if b.side is side]) * scale, 0, full_scale).astype(dtype)
            for side in sides
        }
        pings = tuple(
            Ping(
                number=1000 + row,
                time_utc_s=1.0e9 + row / RATE_HZ,
                channels=tuple(ChannelPing(side, images[side][row], RANGE_M) for side in sides),
                lat_deg=60.0 + row * SPEED_MPS / RATE_HZ / 111_412.0 if navigation else None,
                lon_deg=5.0 if navigation else None,
                heading_deg=0.0 if navigation else None,
                altitude_m=ALTITUDE_M if altitude else None,
                depth_m=12.0,
                speed_mps=SPEED_MPS if navigation else None,
            )
            for row in range(PINGS)
        )
        return Survey(Path("made.xtf"), "made", "made", pings)

    return create
