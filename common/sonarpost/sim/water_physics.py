"""Range, travel time, signal-to-noise ratio and frame error rate in the simulated water.

Deliberately small: straight rays at one sound speed, spherical spreading and absorption at 25 kHz. Multipath,
Doppler, noise that changes with time, and shadow zones are not modelled.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType

ABSORPTION_DB_PER_KM = 5.5
"""Sea water at 25 kHz, about 10 degrees C (Thorp's formula gives 5 to 6 dB/km there)."""

_ERROR_RATES: Mapping[int, tuple[tuple[float, float], ...]] = MappingProxyType(
    {
        # (SNR in dB, frame error rate): the points WHOI's open tables give for rates 1, 3 and 5.
        1: ((-7.96, 1.0), (-7.23, 0.73), (-6.85, 0.17), (-6.01, 0.0)),
        3: ((-2.92, 1.0), (-1.59, 0.57), (-0.83, 0.115), (0.0, 0.025), (1.0, 0.0)),
        5: ((3.10, 1.0), (4.44, 0.135), (6.02, 0.0)),
    }
)
# An assumption: a rate without a published table behaves as the published one nearest in throughput.
_TABLE_OF_RATE: Mapping[int, int] = MappingProxyType({0: 1, 1: 1, 2: 1, 3: 3, 4: 3, 5: 5, 6: 1})


@dataclass(frozen=True, slots=True)
class Position:
    """Where a modem is, in metres: east, north, depth (down)."""

    east_m: float = 0.0
    north_m: float = 0.0
    depth_m: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (self.east_m, self.north_m, self.depth_m)):
            raise ValueError(f"position: got {self!r}, expected finite metres")

    def range_m(self, other: Position) -> float:
        """Return the straight distance to `other` in metres."""
        return math.dist((self.east_m, self.north_m, self.depth_m), (other.east_m, other.north_m, other.depth_m))


def snr_db(range_m: float, snr_at_1m_db: float) -> float:
    """Return the signal-to-noise ratio in dB at `range_m` metres.

    Formula: SNR(r) = SNR(1 m) - 20 log10(r) - absorption x r; ranges below 1 m count as 1 m.
    """
    distance_m = max(1.0, range_m)
    return snr_at_1m_db - 20.0 * math.log10(distance_m) - ABSORPTION_DB_PER_KM * distance_m / 1000.0


def frame_error_rate(rate: int, snr: float) -> float:
    """Return the chance, 0..1, that a frame of `rate` at `snr` dB is lost: linear between the published points.

    Raises:
        KeyError: A rate outside 0..6.
    """
    table = _ERROR_RATES[_TABLE_OF_RATE[rate]]
    if snr <= table[0][0]:
        return table[0][1]
    for (low_db, low), (high_db, high) in pairwise(table):
        if snr <= high_db:
            return low + (high - low) * (snr - low_db) / (high_db - low_db)
    return table[-1][1]
