"""Pairs of simulated snippets, with speckle and without: the same survey, simulated twice with the same random draws.

Both snippets of a pair have the grey scale of the one with speckle:
grey = amplitude * min(255 / 99.5th percentile of the amplitude, 8), limited to 0..255.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.scene_measures import ObjectPlace, place_in_window
from sonarpost.codec.interface import Image
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import Side

HEIGHT_PX: Final = 80
WIDTH_PX: Final = 140
MAX_PAIRS: Final = 10_000
FIRST_SEED: Final = 2_000_000
"""No model is trained on these seeds: training uses 100000 to 100260."""
_SEEDS_A_SET: Final = 1_000
_PINGS: Final = 300
_OBJECTS_PER_LINE: Final = 4
"""Of each sort: mine-like objects and other ones."""
_RANDOM_PER_LINE: Final = 2
_PER_LINE: Final = 2 * _OBJECTS_PER_LINE + _RANDOM_PER_LINE
_HIGH_PERCENTILE: Final = 99.5
_MAX_GAIN: Final = 8.0
_OBJECT_COLUMN: Final = WIDTH_PX // 4
"""Column of an object before a random shift: three quarters of the snippet are behind it, for its shadow."""
_SHIFT_PX: Final = 6

Amplitudes = npt.NDArray[np.float32]


@dataclass(frozen=True)
class SpecklePair:
    """One snippet with and without speckle.

    Attributes:
        name: Survey line and number.
        source: Survey line.
        seabed: Type of seabed.
        noisy: Shape (80, 140), uint8, as a sonar records it.
        clean: The same scene without speckle, same shape and grey scale.
        place: Place of the object that the snippet was cut around; None for a snippet at a random place.
    """

    name: str
    source: str
    seabed: SeabedKind
    noisy: Image
    clean: Image
    place: ObjectPlace | None


def speckle_pairs(count: int, seed: int = 0, pings: int = _PINGS) -> list[SpecklePair]:
    """Return pairs from surveys over every kind of seabed.

    Four fifths of the snippets are cut around an object, the others at random places. The kinds of seabed alternate, so
    the first six pairs have one of each.

    Args:
        count: Number of pairs, 1..10,000.
        seed: The same values give the same pairs, 0..1,000,000.
        pings: Length of a survey, more than 80. Eight objects must fit on it.

    Raises:
        ConfigError: A number out of range.
    """
    if not 1 <= count <= MAX_PAIRS:
        raise ConfigError("research", "--count", count, f"1..{MAX_PAIRS}")
    if not 0 <= seed <= 1_000_000:
        raise ConfigError("research", "--seed", seed, "0..1000000")
    kinds = tuple(SeabedKind)
    lines = max(min(count, len(kinds)), -(-count // _PER_LINE))
    by_line = []
    for line in range(lines):
        spec = SurveySpec(
            seed=FIRST_SEED + _SEEDS_A_SET * seed + line,
            pings=pings,
            seabed=kinds[line % len(kinds)],
            targets=_OBJECTS_PER_LINE,
            clutter=_OBJECTS_PER_LINE,
        )
        # With fewer than _PER_LINE snippets of a line, its first ones: they are in random order.
        by_line.append(list(_cut_line(spec))[: -(-count // lines)])
    interleaved = [pairs[number] for number in range(-(-count // lines)) for pairs in by_line]
    return interleaved[:count]


def _cut_line(spec: SurveySpec) -> Iterator[SpecklePair]:
    simulated, clean = simulate_survey(spec), simulate_survey(spec, speckle=False)
    rng = np.random.default_rng(spec.seed)
    centres: list[tuple[Side, int, int, int | None]] = []
    for number, item in enumerate(simulated.truth):
        down, right = (int(value) for value in rng.integers(-_SHIFT_PX, _SHIFT_PX + 1, 2))
        top, left = item.ping + down - HEIGHT_PX // 2, item.sample_index + right - _OBJECT_COLUMN
        centres.append((item.side, top, left, number))
    sides = simulated.survey.sides()
    for _ in range(_RANDOM_PER_LINE):
        side = sides[int(rng.integers(len(sides)))]
        centres.append((side, int(rng.integers(0, spec.pings)), int(rng.integers(0, spec.samples)), None))
    for number in rng.permutation(len(centres)):
        side, top, left, index = centres[int(number)]
        top = min(max(top, 0), spec.pings - HEIGHT_PX)
        left = min(max(left, 0), spec.samples - WIDTH_PX)
        window = (slice(top, top + HEIGHT_PX), slice(left, left + WIDTH_PX))
        noisy, without = simulated.survey.waterfall(side)[window], clean.survey.waterfall(side)[window]
        gain = grey_gain(noisy)
        place = None
        if index is not None:
            item = simulated.truth[index]
            altitude_m = simulated.survey.pings[item.ping].altitude_m
            assert altitude_m is not None
            place = place_in_window(item, spec, altitude_m, top, left)
        line = simulated.survey.line_name
        yield SpecklePair(
            f"{line} {number}", line, spec.seabed, scaled_grey(noisy, gain), scaled_grey(without, gain), place
        )


def grey_gain(amplitude: Amplitudes) -> float:
    """Return the grey levels per unit of amplitude: 255 at the 99.5th percentile, at most 8."""
    high = float(np.percentile(amplitude, _HIGH_PERCENTILE))
    return min(255.0 / high, _MAX_GAIN) if high > 0 else _MAX_GAIN


def scaled_grey(amplitude: Amplitudes, gain: float) -> Image:
    """Return amplitude times gain, rounded and limited to 0..255, uint8."""
    return np.asarray(np.clip(np.rint(amplitude * gain), 0, 255), dtype=np.uint8)
