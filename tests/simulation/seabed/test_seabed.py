from __future__ import annotations

import math

import numpy as np
import pytest

from sonarpost.simulation.seabed.targets import (
    CLUTTER_KINDS,
    MINE_LIKE_KINDS,
    ObjectKind,
    SeabedObject,
    place_object,
    random_object,
    surface_height_m,
)
from sonarpost.simulation.seabed.terrain import Seabed, SeabedKind, make_seabed


def strip(kind: SeabedKind, seed: int = 4, cell_m: float = 0.1) -> Seabed:
    rng = np.random.default_rng(seed)
    return make_seabed(kind, along_m=(-2.0, 40.0), across_m=(-30.0, 30.0), cell_m=cell_m, rng=rng)


@pytest.mark.parametrize("kind", list(SeabedKind))
def test_every_kind_is_finite_seeded_and_of_the_shape_asked_for(kind):
    bed, again, other = strip(kind), strip(kind), strip(kind, seed=5)
    assert bed.height_m.shape == bed.backscatter.shape == (421, 601)
    assert bed.height_m.dtype == bed.backscatter.dtype == np.float32
    assert np.isfinite(bed.height_m).all()
    assert (bed.backscatter > 0).all()
    np.testing.assert_array_equal(bed.height_m, again.height_m)
    np.testing.assert_array_equal(bed.backscatter, again.backscatter)
    assert not np.array_equal(bed.height_m, other.height_m)


def test_bottoms_differ_as_they_do_at_sea():
    echo = {kind: float(strip(kind).backscatter.mean()) for kind in SeabedKind}
    assert echo[SeabedKind.MUD] * 2 < echo[SeabedKind.SAND] < echo[SeabedKind.GRAVEL]
    relief = {kind: float(np.std(np.diff(strip(kind).height_m, axis=1))) for kind in SeabedKind}
    assert relief[SeabedKind.MUD] < relief[SeabedKind.SAND] < relief[SeabedKind.RIPPLES] < relief[SeabedKind.ROCK]


def test_ripples_have_a_wavelength_and_mud_has_none():
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


def test_sampling_meets_the_cells_and_stays_constant_beyond_the_edge():
    bed = strip(SeabedKind.ROCK)
    height, echo = bed.sampled(np.array([-2.0, 3.0, 3.05, 999.0]), np.array([-30.0, 0.0, 0.0, 999.0]))
    assert height[0] == bed.height_m[0, 0]
    assert height[1] == pytest.approx(bed.height_m[50, 300], abs=1e-4)
    assert height[2] == pytest.approx((bed.height_m[50, 300] + bed.height_m[51, 300]) / 2, abs=1e-4)
    assert echo[3] == bed.backscatter[-1, -1]


@pytest.mark.parametrize(
    ("along", "across", "cell"), [((0, 0), (-1, 1), 0.1), ((0, 9), (1, 1), 0.1), ((0, 9), (-1, 1), 0.0)]
)
def test_no_strip(along, across, cell):
    with pytest.raises(ValueError, match="strip: got"):
        make_seabed(SeabedKind.SAND, along_m=along, across_m=across, cell_m=cell, rng=np.random.default_rng(0))


def test_a_strip_too_large_is_refused_before_it_is_made():
    with pytest.raises(ValueError, match="memory"):
        make_seabed(SeabedKind.SAND, along_m=(0, 1e5), across_m=(0, 1e3), cell_m=0.01, rng=np.random.default_rng(0))


def plan(extent_m: float = 6.0, step_m: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    axis = np.arange(-extent_m, extent_m + step_m / 2, step_m, dtype=np.float32)
    u, v = np.meshgrid(axis, axis, indexing="ij")
    return u, v


@pytest.mark.parametrize("kind", list(ObjectKind))
def test_every_object_has_about_the_size_it_says(kind):
    rng = np.random.default_rng(8)
    u, v = plan()
    for _ in range(4):
        thing = random_object(kind, 0.0, 0.0, rng)
        top = surface_height_m(thing, u, v)
        assert (top >= 0).all()
        tall = 0.75 * thing.height_m, 1.25 * thing.height_m
        assert tall[0] <= top.max() <= tall[1]
        solid = top > 0.3 * top.max()
        long_m = u[solid].max() - u[solid].min()
        wide_m = v[solid].max() - v[solid].min()
        assert 0.5 * thing.length_m < long_m <= 1.3 * thing.length_m + 0.05
        assert wide_m <= 1.3 * max(thing.width_m, 0.4 * thing.length_m) + 0.5


def test_mine_shapes_are_exact():
    u, v = plan()
    cylinder = SeabedObject(ObjectKind.CYLINDER, 0, 0, length_m=2.0, width_m=0.5, height_m=0.5)
    top = surface_height_m(cylinder, u, v)
    middle = u.shape[0] // 2
    assert top[middle, middle] == pytest.approx(0.5)
    assert top[middle, middle + 5] == pytest.approx(0.25 + math.sqrt(0.25**2 - 0.1**2), abs=1e-3)
    assert (top > 0).any(axis=1).sum() * 0.02 == pytest.approx(2.0, abs=0.05)
    cone = SeabedObject(ObjectKind.TRUNCATED_CONE, 0, 0, length_m=1.0, width_m=1.0, height_m=0.44)
    top = surface_height_m(cone, u, v)
    assert (top > 0).sum() * 0.02**2 == pytest.approx(math.pi / 4, rel=0.02)
    assert (top >= 0.4399).sum() * 0.02**2 == pytest.approx(math.pi * 0.275**2, rel=0.03)
    sphere = SeabedObject(ObjectKind.SPHERE, 0, 0, length_m=1.0, width_m=1.0, height_m=0.5)
    assert surface_height_m(sphere, u, v).sum() * 0.02**2 == pytest.approx(2 / 3 * math.pi * 0.5**3, rel=0.02)


def test_only_the_mine_shapes_are_mine_like():
    assert set(MINE_LIKE_KINDS) | set(CLUTTER_KINDS) == set(ObjectKind)
    rng = np.random.default_rng(0)
    assert [random_object(k, 0, 0, rng).is_mine_like for k in MINE_LIKE_KINDS] == [True] * 4
    assert [random_object(k, 0, 0, rng).is_mine_like for k in CLUTTER_KINDS] == [False] * 3


def flat(cell_m: float = 0.05) -> Seabed:
    shape = (401, 801)
    return Seabed(np.zeros(shape, np.float32), np.full(shape, 0.3, np.float32), cell_m, 0.0, -20.0)


def test_an_object_is_put_where_and_how_it_is_asked_for():
    bed = flat()
    thing = SeabedObject(ObjectKind.CYLINDER, 10.0, 5.0, 2.0, 0.5, 0.5, orientation_deg=90)
    assert place_object(bed, thing) == 0.0
    rows, columns = np.nonzero(bed.height_m)
    assert (rows.mean() * 0.05, columns.mean() * 0.05 - 20) == pytest.approx((10.0, 5.0), abs=0.03)
    # Turned by 90 degrees it lies across the track.
    assert np.ptp(columns) * 0.05 == pytest.approx(2.0, abs=0.1)
    assert np.ptp(rows) * 0.05 == pytest.approx(0.5, abs=0.1)
    assert (bed.backscatter[rows, columns] > 0.3).all()
    assert (bed.backscatter == np.float32(0.3)).sum() == bed.backscatter.size - rows.size


def test_objects_at_and_beyond_the_edge():
    bed = flat()
    place_object(bed, SeabedObject(ObjectKind.SPHERE, 0.0, 20.0, 1.0, 1.0, 1.0))
    assert bed.height_m[0, -1] == pytest.approx(1.0)
    before = bed.height_m.copy()
    assert math.isnan(place_object(bed, SeabedObject(ObjectKind.SPHERE, 900.0, 0.0, 1.0, 1.0, 1.0)))
    assert math.isnan(place_object(bed, SeabedObject(ObjectKind.SPHERE, -900.0, 0.0, 1.0, 1.0, 1.0)))
    np.testing.assert_array_equal(bed.height_m, before)
