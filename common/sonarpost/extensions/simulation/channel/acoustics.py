"""Sonar equation: positions, sound absorption, ambient noise, transmission loss and frame error rate.

SNR = SL - TL - NL - 10 log10(bandwidth), with straight rays at one sound speed. TL holds spreading and absorption.
Multipath, Doppler and shadow zones are not modelled; see docs/explanation/channel-model.md.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType

SPHERICAL_DB_PER_DECADE = 20.0

_ERROR_RATES: Mapping[int, tuple[tuple[float, float], ...]] = MappingProxyType(
    {
        # (SNR in dB, frame error rate) at rates 1, 3 and 5, from the tables of WHOI's ros_acomms.
        1: ((-7.96, 1.0), (-7.23, 0.73), (-6.85, 0.17), (-6.01, 0.0)),
        3: ((-2.92, 1.0), (-1.59, 0.57), (-0.83, 0.115), (0.0, 0.025), (1.0, 0.0)),
        5: ((3.10, 1.0), (4.44, 0.135), (6.02, 0.0)),
    }
)
# Assumption: a rate without a published table behaves as the published rate nearest in throughput.
_TABLE_OF_RATE: Mapping[int, int] = MappingProxyType({0: 1, 1: 1, 2: 1, 3: 3, 4: 3, 5: 5, 6: 1})


@dataclass(frozen=True, slots=True)
class LocalPosition:
    """Position in a local frame: metres east, north and down."""

    east_m: float = 0.0
    north_m: float = 0.0
    depth_m: float = 0.0

    def range_m(self, other: "LocalPosition") -> float:
        """Return the straight distance to `other` in metres."""
        return math.dist((self.east_m, self.north_m, self.depth_m), (other.east_m, other.north_m, other.depth_m))


def absorption_db_per_km(frequency_hz: float, temperature_c: float = 10.0, salinity_psu: float = 35.0) -> float:
    """Return the absorption of sound in sea water near the surface, at pH 8, dB/km.

    Source: Ainslie and McColm, "A simplified formula for viscous and chemical absorption in sea water", JASA 103
    (1998). It sums boric acid, magnesium sulphate and pure water, within 10 % of Francois and Garrison (1982) from
    100 Hz to 1 MHz.
    """
    f, t = frequency_hz / 1000.0, temperature_c
    f1 = 0.78 * math.sqrt(salinity_psu / 35.0) * math.exp(t / 26.0)
    f2 = 42.0 * math.exp(t / 17.0)
    boric_acid = 0.106 * f1 * f**2 / (f**2 + f1**2)
    magnesium = 0.52 * (1.0 + t / 43.0) * (salinity_psu / 35.0) * f2 * f**2 / (f**2 + f2**2)
    return boric_acid + magnesium + 0.00049 * f**2 * math.exp(-t / 27.0)


def noise_db_per_hz(frequency_hz: float, wind_m_per_s: float = 5.0, shipping: float = 0.5) -> float:
    """Return the spectrum level of ambient noise, dB re 1 uPa^2/Hz: turbulence, shipping, wind and thermal noise.

    Source: Wenz's curves as given by Coates, "Underwater acoustic systems" (1990), and Stojanovic, "On the relationship
    between capacity and distance in an underwater acoustic communication channel" (WUWNet 2006). Shipping is an
    activity from 0 (none) to 1 (heavy).
    """
    f = frequency_hz / 1000.0
    sources_db = (
        17.0 - 30.0 * math.log10(f),
        40.0 + 20.0 * (shipping - 0.5) + 26.0 * math.log10(f) - 60.0 * math.log10(f + 0.03),
        50.0 + 7.5 * math.sqrt(wind_m_per_s) + 20.0 * math.log10(f) - 40.0 * math.log10(f + 0.4),
        -15.0 + 20.0 * math.log10(f),
    )
    return 10.0 * math.log10(sum(10.0 ** (level_db / 10.0) for level_db in sources_db))


def transmission_loss_db(range_m: float, absorption_db_per_km: float, spreading_db_per_decade: float) -> float:
    """Return the loss from 1 m to `range_m`, dB; ranges below 1 m count as 1 m.

    Source: TL = k log10(r) + a r (Urick, "Principles of underwater sound"), k being 20 for spherical, 15 for practical
    and 10 for cylindrical spreading.
    """
    distance_m = max(1.0, range_m)
    return spreading_db_per_decade * math.log10(distance_m) + absorption_db_per_km * distance_m / 1000.0


def frame_error_rate(rate: int, snr_db: float) -> float:
    """Return the probability, 0..1, that a frame of `rate` is lost: linear between the published points.

    Only those of the Micro-Modem are published; another rate has that of rate 1, the most robust one.
    """
    table = _ERROR_RATES[_TABLE_OF_RATE.get(rate, 1)]
    if snr_db <= table[0][0]:
        return table[0][1]
    for (low_db, low), (high_db, high) in pairwise(table):
        if snr_db <= high_db:
            return low + (high - low) * (snr_db - low_db) / (high_db - low_db)
    return table[-1][1]
