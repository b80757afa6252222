"""Images in true metres: shape, gain, scale bar, north."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.messages import Contact
from sonarpost.review.true_scale import (
    ImageLine,
    auto_gain,
    bar_length_m,
    draw_lines,
    north_in_image,
    scale_strip,
    thumbnail,
    true_image,
)

NOTHING_MISSING = np.zeros((79, 137), np.bool_)
NOISE = np.random.default_rng(1).integers(20, 200, (79, 137), dtype=np.uint8)


def contact(**fields):
    return Contact.model_validate({"contact_id": "c", "vehicle_id": "uuv-1", **fields})


def test_shape_is_that_of_the_seabed():
    found = true_image(NOISE, NOTHING_MISSING, 0.12, 0.03, 900)
    height, width = found.pixels.shape
    assert height == 900
    assert width / height == pytest.approx(137 * 0.03 / (79 * 0.12), rel=0.002)
    assert found.px_per_m == pytest.approx(900 / (79 * 0.12))


@given(
    st.tuples(st.integers(1, 400), st.integers(1, 400)),
    st.floats(0.01, 2.0),
    st.floats(0.01, 2.0),
    st.integers(32, 300),
)
def test_every_image_fits_and_is_true_within_a_pixel(shape, along_m, across_m, longest_px):
    found = true_image(np.zeros(shape, np.uint8), np.zeros(shape, np.bool_), along_m, across_m, longest_px)
    assert max(found.pixels.shape) == longest_px
    assert found.px_per_m is not None
    for size_px, size_m in zip(found.pixels.shape, (shape[0] * along_m, shape[1] * across_m), strict=True):
        assert abs(size_px - size_m * found.px_per_m) <= 1


def test_square_on_the_seabed_is_drawn_square():
    image = np.zeros((100, 100), np.uint8)
    image[40:45, 30:50] = 255  # 0.5 m by 0.5 m
    found = true_image(image, np.zeros(image.shape, np.bool_), 0.1, 0.025, 1000)
    bright = found.pixels > 128
    assert abs(int(bright.any(axis=1).sum()) - int(bright.any(axis=0).sum())) <= 2


def test_reduction_is_anti_aliased():
    stripes = np.zeros((400, 400), np.uint8)
    stripes[:, ::2] = 255
    found = true_image(stripes, np.zeros(stripes.shape, np.bool_), 0.1, 0.1, 50)
    # Nearest neighbours give black or white.
    assert found.pixels[5:-5, 5:-5].min() > 100
    assert found.pixels[5:-5, 5:-5].max() < 155


@pytest.mark.parametrize("sizes", [(None, 0.1), (0.1, None), (None, None)])
def test_unknown_scale_keeps_the_shape_of_the_pixels(sizes):
    found = true_image(NOISE, NOTHING_MISSING, *sizes, 274)
    assert (found.pixels.shape, found.px_per_m) == ((158, 274), None)
    # The strip says so: it differs from that of a known scale.
    assert not np.array_equal(scale_strip(274, 274, None), scale_strip(274, 274, 20.0))


def test_gain_is_that_of_98_percent_of_the_received_pixels():
    image = np.full((10, 100), 51, np.uint8)
    image[:, 50:] = 102
    image[0, 0], image[0, 99] = 0, 255  # 0.1 % each
    missing = np.zeros(image.shape, np.bool_)
    assert auto_gain(image, missing) == pytest.approx((20, 40))
    found = true_image(image, missing, 0.1, 0.1, 100)
    assert (found.pixels[5, 10], found.pixels[5, 90]) == (0, 255)
    # Missing pixels are black and do not count.
    missing[:, :40], image[:, :40] = True, 0
    assert auto_gain(image, missing) == pytest.approx((20, 40))
    assert auto_gain(image, np.ones(image.shape, np.bool_)) == auto_gain(
        np.full((3, 3), 9, np.uint8), missing[:3, 50:53]
    )


def test_missing_area_is_hatched():
    missing = NOTHING_MISSING.copy()
    missing[40:] = True
    found = true_image(NOISE, missing, 0.1, 0.1, 137)
    assert set(np.unique(found.pixels[41:])) == {70, 160}
    assert len(np.unique(found.pixels[:39])) > 20


def test_thumbnail_has_the_shape_of_the_seabed():
    found = thumbnail(NOISE, NOTHING_MISSING, contact(pixel_along_m=0.12, pixel_across_m=0.03))
    assert found.shape == (96, 42)
    assert int(found.max()) - int(found.min()) > 190  # stretched; averaging narrows the range
    assert thumbnail(NOISE, NOTHING_MISSING, None).shape == (55, 96)


@given(st.floats(0.01, 5000))
def test_scale_bar_is_a_round_number(width_m):
    length_m = bar_length_m(width_m)
    assert f"{length_m:e}"[0] in "125"
    assert width_m * 0.159 < length_m <= width_m * 0.4001


def test_scale_bar_has_its_length():
    strip = scale_strip(400, 400, 50.0)  # 8 m wide: a bar of 2 m, 100 px
    row = strip[9, :, 0]
    assert int((row[:60] == 0).sum()) == pytest.approx(52, abs=3)  # the black half and the outline
    assert row[102] == 0
    assert row[106] == 255
    assert (strip[2:17, 108:140] == 0).any(), "its length in metres"


@pytest.mark.parametrize(
    ("heading_deg", "channel", "down_right"),
    [
        (0.0, "starboard", (1, 0)),
        (90.0, "starboard", (0, -1)),  # heading east, right is south: north is left
        (90.0, "port", (0, 1)),
        (180.0, "port", (-1, 0)),
        (270.0, "starboard", (0, 1)),
    ],
)
def test_north(heading_deg, channel, down_right):
    assert north_in_image(contact(heading_deg=heading_deg, channel=channel)) == pytest.approx(down_right, abs=1e-9)


def test_north_is_unknown_without_heading_or_side():
    assert north_in_image(None) is None
    assert north_in_image(contact(heading_deg=1.0)) is None
    assert north_in_image(contact(channel="port")) is None


def test_lines_are_drawn_at_their_place_in_their_colour():
    image = true_image(np.zeros((40, 80), np.uint8), np.zeros((40, 80), np.bool_), 0.2, 0.1, 400)
    # The values are at the top, the line is below them.
    drawn = draw_lines(image, [ImageLine("length", (30.0, 20.0), (30.0, 60.0), "4.00 m")])
    row = drawn[round(30 * image.factors[0])]
    yellow = np.nonzero((row == (255, 212, 0)).all(axis=1))[0]
    assert (yellow.min(), yellow.max()) == pytest.approx((20 * image.factors[1], 60 * image.factors[1]), abs=2)
    assert (draw_lines(image) == 0).all()


def test_mark_points_to_the_contact_and_leaves_it_free():
    image = true_image(np.zeros((40, 80), np.uint8), np.zeros((40, 80), np.bool_), 0.1, 0.1, 400)
    drawn = draw_lines(image, mark=(10.0, 20.0))[:, :, 0]
    assert drawn[50, 2] == drawn[50, 397] == drawn[2, 100] == drawn[197, 100] == 255
    assert (drawn[20:180, 20:380] == 0).all()
