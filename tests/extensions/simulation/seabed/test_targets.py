import dataclasses
import math

import numpy as np
import pytest

from sonarpost.extensions.simulation.seabed.objects import (
    CLUTTER_KINDS,
    FURTHER_CLUTTER_KINDS,
    FURTHER_MINE_LIKE_KINDS,
    MINE_LIKE_KINDS,
    STRUCTURE_KINDS,
    SUSPENDED_KINDS,
    ObjectKind,
    SeabedObject,
    random_object,
    settled,
)
from sonarpost.extensions.simulation.seabed.shapes import surface_backscatter, surface_height_m
from sonarpost.extensions.simulation.seabed.targets import place_object
from sonarpost.extensions.simulation.seabed.terrain import Seabed


def plan(extent_m: float = 6.0, step_m: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    axis = np.arange(-extent_m, extent_m + step_m / 2, step_m, dtype=np.float32)
    u, v = np.meshgrid(axis, axis, indexing="ij")
    return u, v


@pytest.mark.parametrize("kind", [kind for kind in ObjectKind if kind not in SUSPENDED_KINDS])
def test_object_surfaces_have_the_specified_size(kind):
    rng = np.random.default_rng(8)
    u, v = plan(36.0, 0.1) if kind in STRUCTURE_KINDS else plan(10.0, 0.04) if kind in FURTHER_CLUTTER_KINDS else plan()
    for _ in range(4):
        item = random_object(kind, 0.0, 0.0, rng)
        top = surface_height_m(item, u, v)
        assert (top >= 0).all()
        tall = 0.75 * item.height_m, 1.25 * item.height_m
        assert tall[0] <= top.max() <= tall[1]
        solid = top > 0.3 * top.max()
        long_m = u[solid].max() - u[solid].min()
        wide_m = v[solid].max() - v[solid].min()
        assert 0.5 * item.length_m < long_m <= 1.3 * item.length_m + 0.05
        assert wide_m <= 1.3 * max(item.width_m, 0.4 * item.length_m) + 0.5


def test_mine_shapes_match_their_geometry():
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


def test_only_mine_shapes_are_mine_like():
    mines, others = MINE_LIKE_KINDS + FURTHER_MINE_LIKE_KINDS, CLUTTER_KINDS + FURTHER_CLUTTER_KINDS + STRUCTURE_KINDS
    assert set(mines) | set(others) == set(ObjectKind)
    assert len(mines + others) == len(ObjectKind)
    rng = np.random.default_rng(0)
    assert all(random_object(k, 0, 0, rng).is_mine_like for k in mines)
    assert not any(random_object(k, 0, 0, rng).is_mine_like for k in others)


def flat(cell_m: float = 0.05) -> Seabed:
    shape = (401, 801)
    return Seabed(np.zeros(shape, np.float32), np.full(shape, 0.3, np.float32), cell_m, 0.0, -20.0)


def test_object_is_placed_at_its_position_and_orientation():
    bed = flat()
    item = SeabedObject(ObjectKind.CYLINDER, 10.0, 5.0, 2.0, 0.5, 0.5, orientation_deg=90)
    assert place_object(bed, item) == 0.0
    rows, columns = np.nonzero(bed.height_m)
    assert (rows.mean() * 0.05, columns.mean() * 0.05 - 20) == pytest.approx((10.0, 5.0), abs=0.03)
    # Rotated by 90 degrees, it lies across the track.
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


def test_burial_cuts_the_lower_part_of_an_object():
    u, v = plan()
    for kind in (ObjectKind.CYLINDER, ObjectKind.TRUNCATED_CONE, ObjectKind.FINNED_CYLINDER, ObjectKind.TYRE):
        whole = random_object(kind, 0.0, 0.0, np.random.default_rng(3))
        half = dataclasses.replace(whole, height_m=whole.height_m / 2, buried_m=whole.height_m / 2)
        top, cut = surface_height_m(whole, u, v), surface_height_m(half, u, v)
        assert cut.max() == pytest.approx(top.max() / 2, rel=0.15)
        np.testing.assert_allclose(cut, np.clip(top - whole.height_m / 2, 0, None), atol=1e-5)


def test_settled_object_has_less_height_and_stays_the_same_without_settling():
    item = random_object(ObjectKind.CYLINDER, 0.0, 0.0, np.random.default_rng(3))
    assert settled(item, 0.0, 0.0, 0.0, 0.0, np.random.default_rng(1)) == dataclasses.replace(
        item, current_deg=settled(item, 0.0, 0.0, 0.0, 0.0, np.random.default_rng(1)).current_deg
    )
    for seed in range(20):
        sunk = settled(item, 0.6, 8.0, 1.0, 0.0, np.random.default_rng(seed))
        assert sunk.height_m + sunk.buried_m == pytest.approx(item.height_m)
        assert 0.4 * item.height_m <= sunk.height_m <= item.height_m
        assert abs(sunk.tilt_deg) <= 8.0
        assert 0.4 <= sunk.scour <= 1.6
    fish = random_object(ObjectKind.FISH_SCHOOL, 0.0, 0.0, np.random.default_rng(3))
    assert settled(fish, 0.6, 8.0, 1.0, 0.0, np.random.default_rng(1)) == fish


def test_tilt_raises_one_end():
    u, v = plan()
    item = SeabedObject(ObjectKind.CYLINDER, 0, 0, 2.0, 0.5, 0.5, tilt_deg=5.0)
    top = surface_height_m(item, u, v)
    assert top[u > 0.9].max() - top[u < -0.9].max() == pytest.approx(2 * math.tan(math.radians(5.0)), abs=0.03)


def test_scour_digs_a_pit_deepest_towards_the_current():
    bed = flat()
    item = SeabedObject(ObjectKind.TRUNCATED_CONE, 10.0, 0.0, 1.0, 1.0, 0.45, scour=1.0, current_deg=0.0)
    ground_m = place_object(bed, item)
    ahead, behind = bed.height_m[200 + 13, 400], bed.height_m[200 - 13, 400]
    assert -0.25 < ahead < -0.1
    assert ahead < behind - 0.05
    assert ground_m < 0
    # The pit is wider than the object and ends within some heights of it.
    assert bed.height_m[200 + 16, 400] < -0.05
    assert np.abs(bed.height_m[200 + 60 :]).max() < 0.01
    still = flat()
    assert place_object(still, dataclasses.replace(item, scour=0.0)) == 0.0
    assert still.height_m.min() == 0.0


def test_bodies_above_the_seabed():
    bed = flat()
    moored = SeabedObject(ObjectKind.MOORED_SPHERE, 10.0, 5.0, 0.8, 0.8, 2.0)
    place_object(bed, moored)
    (sphere,) = bed.suspended
    assert (sphere.height_m, sphere.radius_m, sphere.fish) == (pytest.approx(1.6), 0.4, 0)
    assert 0.1 < bed.height_m.max() < 0.35  # the anchor
    bare = flat()
    place_object(bare, SeabedObject(ObjectKind.FISH_SCHOOL, 10.0, 5.0, 4.0, 4.0, 2.0))
    assert bare.height_m.max() == 0.0
    assert bare.suspended[0].fish > 50


def test_shapes_have_their_details():
    u, v = plan(step_m=0.02)
    tyre = surface_height_m(SeabedObject(ObjectKind.TYRE, 0, 0, 1.0, 1.0, 0.25), u, v)
    assert tyre[np.hypot(u, v) < 0.15].max() == 0
    assert tyre[(np.hypot(u, v) > 0.3) & (np.hypot(u, v) < 0.38)].min() > 0.2
    pot = surface_height_m(SeabedObject(ObjectKind.CRAB_POT, 0, 0, 0.9, 0.8, 0.4, seed=2), u, v)
    inside = (np.abs(u) < 0.35) & (np.abs(v) < 0.3)
    assert (pot[inside] < 0.6 * 0.4).mean() > 0.5  # sound passes through the mesh
    cone = surface_height_m(SeabedObject(ObjectKind.FLUTED_CONE, 0, 0, 1.0, 1.0, 0.44), u, v)
    rim = np.abs(np.hypot(u, v) - 0.42) < 0.015
    assert np.ptp(cone[rim]) > 0.05


def test_backscatter_of_large_objects_varies():
    u, v = plan(20.0, 0.2)
    wreck = SeabedObject(ObjectKind.WRECK, 0, 0, 30.0, 5.0, 3.0)
    assert np.std(np.log(surface_backscatter(wreck, u, v))) == pytest.approx(0.35, abs=0.12)
    assert surface_backscatter(SeabedObject(ObjectKind.TYRE, 0, 0, 1.0, 1.0, 0.25), u, v) == 0.6
