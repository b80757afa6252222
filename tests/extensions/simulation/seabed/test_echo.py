import dataclasses
import math

import numpy as np
import pytest

from sonarpost.extensions.simulation.seabed.midwater import SonarPath
from sonarpost.extensions.simulation.seabed.objects import ObjectKind, SeabedObject
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, echo_intensity, received_amplitude
from sonarpost.extensions.simulation.seabed.targets import place_object
from sonarpost.extensions.simulation.seabed.terrain import Seabed

SPEC = SurveySpec(samples=1024, range_m=30.0, speed_mps=1.5, ping_rate_hz=15.0)
ALTITUDE_M = 5.0


def flat_bed() -> Seabed:
    shape = (521, 1301)
    return Seabed(np.zeros(shape, np.float32), np.full(shape, 0.3, np.float32), 0.05, -3.0, -32.5)


def straight_track(pings: int = 200) -> SonarPath:
    still = np.zeros(pings)
    return SonarPath(np.arange(pings) * 0.1, still, np.full(pings, ALTITUDE_M), still, still)


def sample_of(ground_m: float, height_m: float = 0.0) -> float:
    return math.hypot(ground_m, ALTITUDE_M - height_m) / SPEC.sample_m


def test_water_column_is_dark_and_ends_at_the_altitude():
    image = echo_intensity(flat_bed(), straight_track(), SPEC, 1)
    first = ALTITUDE_M / SPEC.sample_m
    assert image[:, : int(first) - 3].max() == 0
    assert image[:, int(first) : int(first) + 4].min() > 0.02
    # Flat sand is 1 at half range by definition, and constant along the track.
    assert image[:, 500:524].mean() == pytest.approx(1.0, abs=0.25)
    assert image.std(axis=0).max() < 1e-3


@pytest.mark.parametrize(("sign", "across_m"), [(1, 12.0), (-1, -12.0), (1, 20.0)])
def test_shadow_length_follows_geometry(sign, across_m):
    bed = flat_bed()
    cone = SeabedObject(ObjectKind.TRUNCATED_CONE, 10.0, across_m, 1.0, 1.0, 0.45)
    place_object(bed, cone)
    image = echo_intensity(bed, straight_track(), SPEC, sign)
    row = image[100]
    usual = np.median(np.delete(image, slice(90, 111), axis=0), axis=0)
    # The far rim of the flat top, 0.275 m from the centre, casts the end of the shadow.
    top_m = abs(across_m) + 0.275
    end = sample_of(top_m * ALTITUDE_M / (ALTITUDE_M - 0.45))
    # The shadow begins directly behind that rim: the foot of the cone has a smaller slant range.
    begin = sample_of(top_m, 0.45)
    dark = np.flatnonzero(row[300:] < 0.25 * usual[300:]) + 300
    assert dark.min() == pytest.approx(begin, abs=6)
    assert dark.max() == pytest.approx(end, abs=6)
    assert np.ptp(dark) + 1 == dark.size
    # The highlight of the near face is brighter than the sand and precedes the shadow.
    bright = np.flatnonzero(row > 3 * np.maximum(usual, 0.1))
    assert bright.size >= 4
    assert sample_of(abs(across_m) - 0.6) - 8 < bright.min() < bright.max() < dark.min() + 6
    # The other side does not show the object.
    other = echo_intensity(bed, straight_track(), SPEC, -sign)
    np.testing.assert_allclose(other, other[:1].repeat(200, axis=0), rtol=1e-3)


def test_taller_object_casts_a_longer_shadow():
    lengths = []
    for height in (0.2, 0.5, 1.0):
        bed = flat_bed()
        place_object(bed, SeabedObject(ObjectKind.TRUNCATED_CONE, 10.0, 15.0, 1.0, 1.0, height))
        image = echo_intensity(bed, straight_track(), SPEC, 1)
        lengths.append(int((image[100, 400:] < 0.25 * image[20, 400:]).sum()))
    assert lengths[0] * 1.8 < lengths[1] < lengths[2] / 1.6


def test_beam_widens_with_range():
    def rows_lit(across_m: float) -> int:
        bed = flat_bed()
        bed.backscatter[:] = 0.0
        column = round((across_m + 32.5) / 0.05)
        bed.backscatter[259:262, column - 3 : column + 4] = 1.0
        image = echo_intensity(bed, straight_track(), dataclasses.replace(SPEC, speed_mps=15.0 * 0.02), 1)
        profile = image[:, round(sample_of(across_m))]
        return int((profile > profile.max() / 2).sum())

    # The track still has 0.1 m per ping; only the beam spread is computed for finer pings.
    assert rows_lit(28.0) > rows_lit(8.0) + 2


def test_speckle_statistics_match_recordings():
    rng = np.random.default_rng(0)
    flat = np.full((300, 1024), 1.0, np.float32)
    amplitude = received_amplitude(flat, np.full(300, ALTITUDE_M), SPEC, rng)[:, 300:700]
    rows = amplitude / amplitude.mean(axis=1, keepdims=True)
    assert 0.3 < rows.std() < 0.45
    off = rows - rows.mean()
    near = (off[:, 1:] * off[:, :-1]).mean() / (off**2).mean()
    far = (off[:, 6:] * off[:, :-6]).mean() / (off**2).mean()
    assert 0.2 < near < 0.6
    assert abs(far) < 0.05
