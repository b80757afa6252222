from __future__ import annotations

import itertools

import numpy as np
import pytest

from sonarpost.simulation.seabed.terrain import RippleOptions, Seabed, SeabedKind, make_seabed


def strip(kind: SeabedKind, seed: int = 4, cell_m: float = 0.1) -> Seabed:
    rng = np.random.default_rng(seed)
    return make_seabed(kind, along_m=(-2.0, 40.0), across_m=(-30.0, 30.0), cell_m=cell_m, rng=rng)


@pytest.mark.parametrize("kind", list(SeabedKind))
def test_seabed_is_finite_and_reproducible(kind):
    bed, again, other = strip(kind), strip(kind), strip(kind, seed=5)
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


def test_ripples_have_a_dominant_wavelength():
    def peak_over_mean(kind: SeabedKind) -> float:
        power = np.abs(np.fft.rfft2(strip(kind).height_m)) ** 2
        k = np.hypot(np.fft.fftfreq(421, 0.1)[:, None], np.fft.rfftfreq(601, 0.1)[None, :])
        rings = [power[(k >= low) & (k < low + 0.2)].sum() for low in np.arange(0.6, 4.0, 0.2)]
        return max(rings) / np.mean(rings)

    assert peak_over_mean(SeabedKind.RIPPLES) > 3.5
    wavelengths = np.arange(0.6, 4.0, 0.2)
    power = np.abs(np.fft.rfft2(strip(SeabedKind.RIPPLES).height_m)) ** 2
    k = np.hypot(np.fft.fftfreq(421, 0.1)[:, None], np.fft.rfftfreq(601, 0.1)[None, :])
    strongest = wavelengths[np.argmax([power[(k >= low) & (k < low + 0.2)].sum() for low in wavelengths])]
    assert 0.5 < 1 / (strongest + 0.1) < 1.3


def test_sampling_interpolates_and_is_constant_beyond_the_edge():
    bed = strip(SeabedKind.ROCK)
    height, echo = bed.sampled(np.array([-2.0, 3.0, 3.05, 999.0]), np.array([-30.0, 0.0, 0.0, 999.0]))
    assert height[0] == bed.height_m[0, 0]
    assert height[1] == pytest.approx(bed.height_m[50, 300], abs=1e-4)
    assert height[2] == pytest.approx((bed.height_m[50, 300] + bed.height_m[51, 300]) / 2, abs=1e-4)
    assert echo[3] == bed.backscatter[-1, -1]


@pytest.mark.parametrize(
    ("along", "across", "cell"), [((0, 0), (-1, 1), 0.1), ((0, 9), (1, 1), 0.1), ((0, 9), (-1, 1), 0.0)]
)
def test_empty_strip_is_rejected(along, across, cell):
    with pytest.raises(ValueError, match="strip: got"):
        make_seabed(SeabedKind.SAND, along_m=along, across_m=across, cell_m=cell, rng=np.random.default_rng(0))


def test_too_large_strip_is_rejected():
    with pytest.raises(ValueError, match="memory"):
        make_seabed(SeabedKind.SAND, along_m=(0, 1e5), across_m=(0, 1e3), cell_m=0.01, rng=np.random.default_rng(0))


def rippled(options: RippleOptions | None) -> Seabed:
    rng = np.random.default_rng(4)
    area = {"along_m": (-2.0, 40.0), "across_m": (-30.0, 30.0)}
    return make_seabed(SeabedKind.RIPPLES, **area, cell_m=0.1, rng=rng, ripples=options)


def strongest_wavelength_m(bed: Seabed) -> float:
    power = np.abs(np.fft.rfft2(bed.height_m)) ** 2
    k = np.hypot(np.fft.fftfreq(421, 0.1)[:, None], np.fft.rfftfreq(601, 0.1)[None, :])
    # Logarithmic bands without the slow relief of the sand.
    bands = np.geomspace(0.2, 4.0, 16)
    strongest = np.argmax([power[(k >= a) & (k < b)].sum() for a, b in itertools.pairwise(bands)])
    return float(1 / np.sqrt(bands[strongest] * bands[strongest + 1]))


@pytest.mark.parametrize("wavelength_m", [0.4, 1.5, 3.0])
def test_ripples_have_the_specified_wavelength(wavelength_m):
    bed = rippled(RippleOptions(wavelength_m=wavelength_m))
    assert strongest_wavelength_m(bed) == pytest.approx(wavelength_m, rel=0.3)


def test_further_ripple_systems_are_added_to_the_first():
    one, two = rippled(None), rippled(RippleOptions(systems=2))
    np.testing.assert_array_equal(one.height_m, rippled(RippleOptions()).height_m)
    assert not np.array_equal(two.height_m, rippled(RippleOptions(systems=2, seed=1)).height_m)
    # The first system and the bed are the same.
    assert 0.5 < np.corrcoef(one.height_m.ravel(), two.height_m.ravel())[0, 1] < 0.99
