"""Lines and polygons at the 180th meridian: every part is on one side, and together they are the whole."""

import itertools
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sonarpost.extensions.maps.geometry import split_line, split_ring

QUARTERS = st.integers(-8, 8).map(lambda number: number / 4)
"""Degrees from the meridian or the equator; many are exactly 0."""


def wrapped(offset_deg):
    """Return the longitude at an angle east of the 180th meridian; 180 and -180 are the same meridian."""
    return offset_deg - 180 if offset_deg > 0 else offset_deg + 180


def changes_of_side(offsets_deg, *, closed=False):
    """Return how often a line crosses the meridian; touching it, or following it, is no crossing."""
    sides = [offset > 0 for offset in offsets_deg if offset]
    return sum(one != other for one, other in itertools.pairwise([*sides, *(sides[:1] if closed else [])]))


def area(points):
    """Return the signed area of a closed ring of (x, y), positive counter-clockwise."""
    return sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in itertools.pairwise(points)) / 2


def area_on_side(ring, side):
    """Return the area of a ring of (offset, y) on a side of offset 0: that of the ring moved to 0 from the other."""
    moved = []
    for (x0, y0), (x1, y1) in itertools.pairwise(ring):
        moved.append((x0, y0))
        if x0 * x1 < 0:
            moved.append((0.0, y0 - x0 * (y1 - y0) / (x1 - x0)))
    return area([(max(side * x, 0.0) * side, y) for x, y in [*moved, ring[-1]]])


@given(st.lists(st.tuples(QUARTERS, QUARTERS), min_size=1, max_size=12), st.booleans())
@example([(-1.0, 0.0), (1.0, 1.0), (2.0, 1.0), (-1.0, 2.0)], False)  # crosses twice
@example([(-1.0, 0.0), (0.0, 1.0), (-1.0, 2.0)], True)  # touches
@example([(0.0, 0.0), (1.0, 1.0)], False)  # begins on it
@example([(-1.0, 0.0), (0.0, 1.0), (0.0, 2.0), (1.0, 2.0)], True)  # follows it
def test_a_line_is_divided_where_it_changes_the_side(points, negative):
    stored = [(-180.0 if not x and negative else wrapped(x), y) for x, y in points]
    parts = split_line(stored)
    assert len(parts) == 1 + changes_of_side([x for x, _ in points])
    for part in parts:
        assert all(abs(one[0] - other[0]) < 180 for one, other in itertools.pairwise(part))
    for before, after in itertools.pairwise(parts):
        assert (abs(before[-1][0]), before[-1][0], before[-1][1]) == (180, -after[0][0], after[0][1])
    whole = [(lon % 360, lat) for part in parts for lon, lat in part]
    places = iter(whole)
    assert all(any(place == (lon % 360, lat) for place in places) for lon, lat in stored), "all points, in order"
    length = sum(math.dist(one, other) for one, other in itertools.pairwise(points))
    assert sum(math.dist(one, other) for one, other in itertools.pairwise(whole)) == pytest.approx(length)


@given(st.lists(st.integers(1, 8), min_size=6, max_size=24), QUARTERS, st.floats(-80, 80), st.booleans(), st.booleans())
@example([1, 8] * 12, 0.25, -16.9, True, False)
@example([4, 4, 4, 4], 1.0, 16.9, False, False)  # touches with a corner
def test_a_polygon_is_divided_where_it_changes_the_side(radii, middle_deg, lat_deg, clockwise, negative):
    """Stars have any number of crossings. A corner near the meridian is moved exactly to it."""
    step = 2 * math.pi / len(radii)
    corners = [(middle_deg + r / 4 * math.cos(n * step), r / 4 * math.sin(n * step)) for n, r in enumerate(radii)]
    corners = [(0.0 if abs(x) < 1e-3 else x, y) for x, y in corners]
    ring = [*corners, corners[0]][:: -1 if clockwise else 1]
    stored = [(-180.0 if not x and negative else wrapped(x), lat_deg + y) for x, y in ring]
    rings = split_ring(stored)
    assert len(rings) == 1 + changes_of_side([x for x, _ in corners], closed=True) // 2
    areas = {1: 0.0, -1: 0.0}
    for part in rings:
        assert part[0] == part[-1]
        assert len({*part}) == len(part) - 1 >= 3
        side = 1 if min(lon for lon, _ in part) < 0 else -1
        assert all(lon * side < 0 for lon, _ in part), "eastern longitudes are west of the meridian"
        areas[side] += (own := area([(lon % 360, lat - lat_deg) for lon, lat in part]))
        assert own * area(ring) > 0, "the same direction"
    for side, total in areas.items():
        assert total == pytest.approx(area_on_side(ring, side), abs=1e-9)


def test_a_ring_around_a_pole_is_returned_whole():
    ring = [(lon, 80.0) for lon in (0.0, 90.0, 170.0, -100.0, 0.0)]
    assert split_ring(ring) == [ring]
