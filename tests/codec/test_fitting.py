"""Fitting images of any size into the sides that the codecs accept."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.fitting import fit_image
from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX, check_image
from sonarpost.errors import StreamError

SIDES = st.integers(1, 1200)


@given(
    rows=SIDES, columns=SIDES, fit=st.sampled_from(["refuse", "crop", "resize"]), dtype=st.sampled_from(["u1", "u2"])
)
def test_result_is_accepted_by_every_codec_or_an_error_names_the_sizes(rows, columns, fit, dtype):
    image = np.full((rows, columns), 77, dtype)
    error: StreamError | None = None
    try:
        fitted = fit_image(image, fit, "a.png")
    except StreamError as caught:
        error = caught
    if error is not None:
        assert f"{columns} × {rows} px" in str(error)
        assert "--fit resize" in str(error) or fit == "resize"
        return
    check_image(fitted.pixels)
    assert (fitted.pixels == 77).all()
    height, width = fitted.pixels.shape
    if (height, width) == (rows, columns):
        assert fitted.pixels is image
        assert fitted.notes == ()
        return
    assert f"{columns} × {rows} px" in fitted.notes[0]
    assert f"{width} × {height} px" in fitted.notes[0]
    if fit == "resize":
        assert (fitted.scale_along, fitted.scale_across) == (rows / height, columns / width)
        # The aspect ratio is kept up to half a pixel.
        assert abs(height - width * rows / columns) <= 0.5 * max(1, rows / columns) + 1e-9
    else:
        assert (fitted.scale_along, fitted.scale_across) == (1, 1)


def test_resize_averages_areas():
    blocks = np.random.default_rng(1).integers(0, 65536, (300, 512)).astype(np.uint16)
    fitted = fit_image(np.kron(blocks, np.ones((2, 2), np.uint16)), "resize", "a")
    np.testing.assert_array_equal(fitted.pixels, blocks)
    stripes = np.tile(np.array([0, 100], np.uint8), (600, 512))
    assert set(np.unique(fit_image(stripes, "resize", "a").pixels)) == {50}


def test_crop_keeps_the_centre_and_the_limits_are_kept_without_a_change():
    image = np.arange(20 * 1000).reshape(20, 1000).astype(np.uint16)
    fitted = fit_image(image, "crop", "a")
    np.testing.assert_array_equal(fitted.pixels, image[:, 244:756])
    assert fitted.notes == ("centre of 1000 × 20 px cropped to 512 × 20 px",)
    for size in ((MIN_SIDE_PX, MAX_SIDE_PX), (MAX_SIDE_PX, MIN_SIDE_PX)):
        assert fit_image(np.zeros(size, np.uint8), "refuse", "a").pixels.shape == size


@pytest.mark.parametrize(
    ("size", "fit", "message"),
    [
        (
            (900, 1200),
            "refuse",
            "a.png: size: got '1200 × 900 px', expected 16 to 512 px a side; --fit crop or --fit res",
        ),
        ((10, 100), "crop", "--fit resize enlarges"),
        ((10, 1000), "resize", "1000 × 10 px, after resize 512 × 5 px"),
        ((15, 500), "resize", "500 × 15 px, after resize 533 × 16 px"),
    ],
)
def test_error_names_sizes_and_options(size, fit, message):
    with pytest.raises(StreamError) as caught:
        fit_image(np.zeros(size, np.uint8), fit, "a.png")
    assert message in str(caught.value)
