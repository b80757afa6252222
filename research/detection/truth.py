"""Which object of a simulated survey a contact is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sonarpost.simulation.seabed.survey import TruthObject
from sonarpost.sonar.survey import Side

NEAR_M: Final = 1.5
"""A contact this near to an object's middle, along and across, is that object; half the object's length is added."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Metres along-track between two pings, and across-track between two samples."""

    row_m: float
    sample_m: float


def object_at(truth: Sequence[TruthObject], side: Side, row: int, sample: float, scale: Scale) -> int | None:
    """Return the index of the object that lies at a ping and sample, the nearest one; None where none does."""
    best, best_m = None, float("inf")
    for index, thing in enumerate(truth):
        if thing.side is not side:
            continue
        near_m = NEAR_M + (0.0 if thing.is_mine_like else thing.length_m / 2)
        along_m = abs(row - thing.ping) * scale.row_m
        across_m = abs(sample - thing.sample_index) * scale.sample_m
        if along_m < near_m and across_m < near_m and max(along_m, across_m) < best_m:
            best, best_m = index, max(along_m, across_m)
    return best
