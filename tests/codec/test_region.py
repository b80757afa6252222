"""Box of a region command: bytes, place in an image, invalid values."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.interface import MIN_SIDE_PX
from sonarpost.codec.region import BOX_STEPS, RegionBox
from sonarpost.errors import BadInputError

_edges = st.tuples(st.integers(0, BOX_STEPS - 1), st.integers(1, BOX_STEPS)).filter(lambda pair: pair[0] < pair[1])
boxes = st.builds(lambda rows, columns: RegionBox(rows[0], columns[0], rows[1], columns[1]), _edges, _edges)


@given(boxes)
def test_packing_round_trip_in_three_bytes(box: RegionBox) -> None:
    assert len(box.pack()) == 3
    assert RegionBox.unpack(box.pack()) == box


@given(boxes, st.integers(16, 512), st.integers(16, 512))
def test_box_is_an_image_within_the_image(box: RegionBox, height_px: int, width_px: int) -> None:
    top, left, bottom, right = box.pixels(height_px, width_px)
    assert 0 <= top <= bottom - MIN_SIDE_PX <= height_px - MIN_SIDE_PX
    assert 0 <= left <= right - MIN_SIDE_PX <= width_px - MIN_SIDE_PX
    assert top * BOX_STEPS <= box.top * height_px
    assert bottom * BOX_STEPS >= box.bottom * height_px


def test_place_of_an_example_and_invalid_boxes() -> None:
    assert RegionBox(8, 16, 16, 32).pixels(128, 80) == (32, 40, 64, 80)
    assert RegionBox(0, 31, 1, 32).pixels(80, 80) == (0, 64, 16, 80)
    for edges in ((0, 0, 0, 32), (4, 0, 3, 32), (0, 0, 33, 32), (-1, 0, 4, 4), (0, 8, 32, 8)):
        with pytest.raises(BadInputError):
            RegionBox(*edges)
    for data in (b"", b"\0\0", b"\0\0\x01", b"\xf8\0\0"):
        with pytest.raises(BadInputError):
            RegionBox.unpack(data)
