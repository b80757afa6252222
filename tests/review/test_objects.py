"""Association of looks: which looks are one object."""

import random
from dataclasses import replace

import pytest

from sonarpost.review.objects import AssociationRule, Look, associate, fuse_positions, looks_within_gate, ordered_pair
from sonarpost.review.positions import destination

RULE = AssociationRule(8.0, 6 * 3600.0)
ORIGIN = (56.0, -5.0)


def look(name, east_m=0.0, north_m=0.0, sigma_m=None, **fields):
    lat, lon = destination(*destination(*ORIGIN, 0.0, north_m), 90.0, east_m)
    return Look(name, lat, lon, sigma_m, **fields)


def simulated_looks(spacing_m, sigma_m, seed, passes=4):
    """Looks of several passes at 16 objects on a grid; returns the looks and the true objects."""
    draws = random.Random(seed)
    looks, truth = [], []
    for number in range(16):
        names = [f"{number:02}-{one}" for one in range(passes)]
        truth.append(tuple(names))
        for one, name in enumerate(names):
            east, north = (spacing_m * place + draws.gauss(0, sigma_m) for place in divmod(number, 4))
            looks.append(look(name, east, north, sigma_m, vehicle_id="uuv-1", seen_utc_s=2000.0 * one + 3.0 * number))
    return looks, truth


def rate_of_whole_objects(spacing_m, sigma_m, runs=10):
    """Share of the objects whose looks are all together, without any of another object."""
    found = 0
    for seed in range(runs):
        looks, truth = simulated_looks(spacing_m, sigma_m, seed)
        found += len(set(truth) & set(associate(looks, RULE)))
    return found / (16 * runs)


@pytest.mark.parametrize(
    ("spacing_m", "sigma_m", "least"), [(20.0, 1.0, 0.99), (20.0, 3.0, 0.9), (40.0, 5.0, 0.9), (60.0, 10.0, 0.75)]
)
def test_rate_of_whole_objects(spacing_m, sigma_m, least):
    assert rate_of_whole_objects(spacing_m, sigma_m) >= least


def test_order_of_the_looks_does_not_change_the_objects():
    looks, _ = simulated_looks(20.0, 6.0, 1)
    expected = associate(looks, RULE)
    for seed in range(5):
        random.Random(seed).shuffle(looks)
        assert associate(looks, RULE) == expected


@pytest.mark.parametrize(
    ("distance_m", "sigma_m", "is_one"),
    [
        (7.9, None, True),
        (8.1, None, False),
        (7.9, 0.1, True),
        (30.0, 7.5, True),
        (34.0, 7.5, False),
        (66.0, 500.0, False),
    ],
)
def test_gate_widens_with_the_position_errors(distance_m, sigma_m, is_one):
    found = associate([look("a", sigma_m=sigma_m), look("b", distance_m, sigma_m=sigma_m)], RULE)
    assert found == ([("a", "b")] if is_one else [("a",), ("b",)])


def test_looks_of_one_pass_are_compared_without_the_common_error():
    first = look("a", sigma_m=7.0, vehicle_id="uuv-1", seen_utc_s=1000.0)
    other = look("b", 12.0, sigma_m=7.0, vehicle_id="uuv-1", seen_utc_s=1010.0)
    assert len(associate([first, other], RULE)) == 2
    for changes in ({"seen_utc_s": 1500.0}, {"vehicle_id": "uuv-2"}, {"lon_deg": ORIGIN[1] + 1e-5}):
        assert len(associate([first, replace(other, **changes)], RULE)) == 1


def test_looks_of_two_missions_are_two_objects():
    first = look("a", seen_utc_s=0.0)
    assert len(associate([first, look("b", 1.0, seen_utc_s=6 * 3600.0)], RULE)) == 1
    assert len(associate([first, look("b", 1.0, seen_utc_s=6 * 3600.0 + 1)], RULE)) == 2
    assert len(associate([first, look("b", 1.0)], RULE)) == 1


@pytest.mark.parametrize(
    ("one", "other", "is_one"),
    [
        ((1.0, 0.5, 0.5), (0.5, 1.2, 0.5), True),  # from another aspect
        ((1.0, 0.5, 0.5), (9.0, 2.0, 0.5), False),
        ((1.0, 0.5, 0.3), (1.0, 0.5, 3.0), False),
        ((0.1, 0.1, 0.1), (0.5, 0.5, 0.5), True),  # a few pixels
        ((1.0, 0.5, None), (None, 9.0, 4.0), True),
    ],
)
def test_sizes_must_be_compatible(one, other, is_one):
    names = ("length_m", "width_m", "height_m")
    looks = [look("a", **dict(zip(names, one, strict=True))), look("b", 2.0, **dict(zip(names, other, strict=True)))]
    assert (len(associate(looks, RULE)) == 1) is is_one


def test_size_decides_between_two_places():
    large = {"length_m": 8.0, "width_m": 3.0}
    small = {"length_m": 1.0, "width_m": 0.5}
    looks = [look("a", 0.0, **small), look("b", 6.0, **large), look("c", 4.0, **small)]
    assert associate(looks, RULE) == [("a", "c"), ("b",)]


def test_looks_that_a_person_joined_or_separated():
    looks = [look("a"), look("b", 3.0), look("c", 100.0)]
    assert associate(looks, RULE) == [("a", "b"), ("c",)]
    assert associate(looks, RULE, apart={("a", "b")}) == [("a",), ("b",), ("c",)]
    assert associate(looks, RULE, together={("b", "c")}, apart={("a", "b")}) == [("a",), ("b", "c")]
    # A look near one of two joined looks joins them: their scatter widens the gate.
    looks = [look("a"), look("b", 20.0), look("c", 19.0, 2.0)]
    assert associate(looks, RULE, together={("a", "b")}) == [("a", "b", "c")]


def test_fused_position():
    points = [(0.0, 0.0), (3.0, 0.0)]
    looks = [look("a", sigma_m=1.0, seen_utc_s=0.0), look("b", sigma_m=2.0, seen_utc_s=1000.0)]
    fused = fuse_positions(looks, points, RULE)
    assert (fused.x_m, fused.y_m) == pytest.approx((0.6, 0.0))
    assert fused.sigma_m == pytest.approx((1 + 1 / 4) ** -0.5)
    # Looks of one pass share the navigation error: a second one does not reduce it.
    looks = [replace(one, vehicle_id="uuv-1", seen_utc_s=0.0, sigma_m=2.0) for one in looks]
    fused = fuse_positions(looks, points, RULE)
    assert (fused.x_m, fused.sigma_m) == pytest.approx((1.5, 2.0))
    assert fuse_positions([look("a"), look("b")], points, RULE).sigma_m is None
    far = fuse_positions([look("a", sigma_m=1.0), look("b", sigma_m=1.0, vehicle_id="x")], [(0, 0), (20, 0)], RULE)
    assert far.scatter == pytest.approx(10.0)


def test_looks_within_the_gate_of_a_look():
    others = [look("b", 5.0, seen_utc_s=1.0), look("c", 50.0)]
    assert [one.contact_id for one in looks_within_gate(look("a", seen_utc_s=1e6), others, RULE)] == ["b"]
    assert associate([], RULE) == []
    assert ordered_pair("b", "a") == ("a", "b")
