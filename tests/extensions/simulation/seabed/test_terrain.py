import itertools
from functools import cache

import numpy as np
import pytest

from sonarpost.extensions.simulation.seabed.terrain import RippleOptions, Seabed, SeabedKind, make_seabed


@cache
def strip(kind: SeabedKind, seed: int = 4, ripples: RippleOptions | None = None) -> Seabed:
    rng = np.random.default_rng(seed)
    return make_seabed(kind, along_m=(-2.0, 40.0), across_m=(-30.0, 30.0), cell_m=0.1, rng=rng, ripples=ripples)


@pytest.mark.parametrize("kind", list(SeabedKind))
def test_seabed_is_finite_and_reproducible(kind):
    bed, again, other = strip(kind), strip.__wrapped__(kind), strip(kind, seed=5)
    assert bed.height_m.shape == bed.backscatter.shape == (421, 601)
    assert bed.height_m.dtype == bed.backscatter.dtype == np.float32
    assert np.isfinite(bed.height_m).all()
    assert (bed.backscatter > 0).all()
    np.testing.assert_array_equal(bed.height_m, again.height_m)
    np.testing.assert_array_equal(bed.backscatter, again.backscatter)
    assert not np.array_equal(bed.height_m, other.height_m)


def test_seabed_types_differ_in_backscatter_and_relief():
    echo = {kind: float(strip(kind).backscatter.mean()) for kind in SeabedKind}
    assert echo[SeabedKind.MUD] * 2 < echo[SeabedKind.SAND] < echo[SeabedKind.GRAVEL]
    relief = {kind: float(np.std(np.diff(strip(kind).height_m, axis=1))) for kind in SeabedKind}
    assert relief[SeabedKind.MUD] < relief[SeabedKind.SAND] < relief[SeabedKind.RIPPLES] < relief[SeabedKind.ROCK]


def power_in_rings(bed: Seabed, numbers: np.ndarray) -> list[float]:
    """Return the power of the heights between successive numbers of waves per metre."""
    power = np.abs(np.fft.rfft2(bed.height_m)) ** 2
    k = np.hypot(np.fft.fftfreq(421, 0.1)[:, None], np.fft.rfftfreq(601, 0.1)[None, :])
    return [float(power[(k >= a) & (k < b)].sum()) for a, b in itertools.pairwise(numbers)]


def test_ripples_have_a_dominant_wavelength():
    numbers = np.arange(0.6, 4.2, 0.2)  # waves per metre
    rings = power_in_rings(strip(SeabedKind.RIPPLES), numbers)
    assert max(rings) / np.mean(rings) > 3.5
    assert 0.5 < 1 / (numbers[np.argmax(rings)] + 0.1) < 1.3


def test_sampling_interpolates_and_is_constant_beyond_the_edge():
    bed = strip(SeabedKind.ROCK)
    height, echo = bed.sampled(np.array([-2.0, 3.0, 3.05, 999.0]), np.array([-30.0, 0.0, 0.0, 999.0]))
    assert height[0] == bed.height_m[0, 0]
    assert height[1] == pytest.approx(bed.height_m[50, 300], abs=1e-4)
    assert height[2] == pytest.approx((bed.height_m[50, 300] + bed.height_m[51, 300]) / 2, abs=1e-4)
    assert echo[3] == bed.backscatter[-1, -1]


@pytest.mark.parametrize(
    ("along", "across", "cell", "message"),
    [
        ((0, 0), (-1, 1), 0.1, "strip: got"),
        ((0, 9), (1, 1), 0.1, "strip: got"),
        ((0, 9), (-1, 1), 0.0, "strip: got"),
        ((0, 1e5), (0, 1e3), 0.01, "memory"),
    ],
)
def test_empty_or_too_large_strip_is_rejected(along, across, cell, message):
    with pytest.raises(ValueError, match=message):
        make_seabed(SeabedKind.SAND, along_m=along, across_m=across, cell_m=cell, rng=np.random.default_rng(0))


@pytest.mark.parametrize("wavelength_m", [0.4, 1.5, 3.0])
def test_ripples_have_the_specified_wavelength(wavelength_m):
    bed = strip(SeabedKind.RIPPLES, ripples=RippleOptions(wavelength_m=wavelength_m))
    # Logarithmic bands without the slow relief of the sand.
    bands = np.geomspace(0.2, 4.0, 16)
    strongest = np.argmax(power_in_rings(bed, bands))
    assert 1 / np.sqrt(bands[strongest] * bands[strongest + 1]) == pytest.approx(wavelength_m, rel=0.3)


def test_further_ripple_systems_are_added_to_the_first():
    one, default, two, other = (
        strip(SeabedKind.RIPPLES, ripples=options)
        for options in (None, RippleOptions(), RippleOptions(systems=2), RippleOptions(systems=2, seed=1))
    )
    np.testing.assert_array_equal(one.height_m, default.height_m)
    assert not np.array_equal(two.height_m, other.height_m)
    # The first system and the bed are the same.
    assert 0.5 < np.corrcoef(one.height_m.ravel(), two.height_m.ravel())[0, 1] < 0.99
