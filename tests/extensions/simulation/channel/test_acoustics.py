"""Absorption, noise and frame error rate against published values."""

import itertools
import math

import pytest

from sonarpost.extensions.simulation.channel.acoustics import absorption_db_per_km, frame_error_rate, noise_db_per_hz
from sonarpost.modem.micromodem import RATES


@pytest.mark.parametrize(("frequency_hz", "db_per_km"), [(1_000, 0.06), (10_000, 1.0), (25_000, 5.1), (100_000, 33.6)])
def test_absorption_matches_the_tables(frequency_hz: float, db_per_km: float):
    # Francois and Garrison (1982) for 10 degrees, 35 psu and the surface; the formula is within 10 %.
    assert absorption_db_per_km(frequency_hz) == pytest.approx(db_per_km, rel=0.12)


def test_absorption_decreases_with_salinity():
    assert absorption_db_per_km(25_000, salinity_psu=0.0) < 0.4


def test_noise_matches_the_wenz_curves():
    # Wind dominates at 25 kHz; at sea state 3 (5 to 8 m/s) Wenz's chart has 35 to 42 dB.
    assert 35.0 < noise_db_per_hz(25_000, wind_m_per_s=5.0) < 42.0
    assert noise_db_per_hz(25_000, wind_m_per_s=15.0) > noise_db_per_hz(25_000, wind_m_per_s=5.0) + 8.0
    assert noise_db_per_hz(100, shipping=1.0) > noise_db_per_hz(100, shipping=0.0) + 15.0
    assert noise_db_per_hz(500_000, wind_m_per_s=0.0) == pytest.approx(-15 + 20 * math.log10(500), abs=0.5)


def test_frame_error_rate_follows_the_published_tables():
    assert frame_error_rate(1, -7.23) == pytest.approx(0.73)
    assert frame_error_rate(1, -20.0) == 1.0
    assert frame_error_rate(5, 6.02) == 0.0
    assert frame_error_rate(5, 3.77) == pytest.approx(0.5675)
    for rate in RATES:
        rates = [frame_error_rate(rate, level / 10) for level in range(-150, 150)]
        assert all(a >= b for a, b in itertools.pairwise(rates))
        assert (rates[0], rates[-1]) == (1.0, 0.0)
