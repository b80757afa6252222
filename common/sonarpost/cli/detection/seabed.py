"""The difficulty of the seabed in the output of `sonarpost detect`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from sonarpost.detection.difficulty import Difficulty, combined
from sonarpost.detection.stream import StripDifficulty


def seabed_text(strips: Sequence[StripDifficulty], threshold: float) -> str:
    """Return the difficulty of a file as one line."""
    difficulty = combined(strip.difficulty for strip in strips)
    if difficulty is None:
        return "seabed: too little of it is known to state its difficulty"
    return (
        f"seabed: {difficulty.clutter_per_1000_m2:.0f} clutter echoes per 1000 m², "
        f"ripples {difficulty.ripple_strength:.1f}, expected Pd {difficulty.expected_pd:.2f} at threshold {threshold:g}"
    )


def seabed_json(strips: Sequence[StripDifficulty], threshold: float) -> dict[str, object]:
    """Return the difficulty of a file and of each side of its strips as JSON types; unknown values are None."""
    return {
        "threshold": threshold,
        **_fields(combined(strip.difficulty for strip in strips)),
        "strips": [
            {
                "first_ping": strip.first_row,
                "end_ping": strip.end_row,
                "channel": strip.side.value,
                **_fields(strip.difficulty),
            }
            for strip in strips
        ],
    }


def _fields(difficulty: Difficulty | None) -> dict[str, float | None]:
    values = {} if difficulty is None else dataclasses.asdict(difficulty)
    return {name: round(values[name], 3) if name in values else None for name in Difficulty.__dataclass_fields__}
