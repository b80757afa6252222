"""Ends of a line at half brightness, on bars of known extent."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from sonarpost.review.highlight_ends import SEARCH_PX, snapped_ends

NOTHING = np.zeros((60, 80), np.bool_)


def bar(first: float, last: float, blur_px: float = 0.0) -> np.ndarray:
    """An image of 60 x 80 px with a bright bar of 9 rows between two columns."""
    edges = np.arange(81, dtype=np.float64)
    cover = np.diff(np.clip(edges, first, last))
    image = np.full((60, 80), 60.0)
    image[26:35] += 120.0 * cover
    return np.rint(gaussian_filter(image, blur_px)).astype(np.uint8)


@pytest.mark.parametrize("blur_px", [0.0, 1.5])
@pytest.mark.parametrize("error_px", [-5.5, 0.0, 2.0])
def test_both_ends_are_found_to_a_fraction_of_a_pixel(blur_px, error_px):
    image = bar(30.3, 52.6, blur_px)
    start, end = snapped_ends(image, NOTHING, (30.5, 30.3 + error_px), (30.5, 52.6 - error_px))
    assert start == (30.5, pytest.approx(30.3, abs=0.25))
    assert end == (30.5, pytest.approx(52.6, abs=0.25))
    # Along the track, and with the ends exchanged.
    after, before = snapped_ends(image.T, NOTHING.T, (52.6 - error_px, 30.5), (30.3 + error_px, 30.5))
    assert (before, after) == ((pytest.approx(start[1], abs=0.02), 30.5), (pytest.approx(end[1], abs=0.02), 30.5))


def test_an_end_without_half_brightness_has_no_place():
    # Flat seabed, a bar that continues beyond the search, and one that ends at the border of the image.
    assert snapped_ends(bar(0, 0), NOTHING, (30.5, 30.0), (30.5, 50.0)) == (None, None)
    start, end = snapped_ends(bar(30, 80), NOTHING, (30.5, 30.0), (30.5, 80.0 - SEARCH_PX - 10))
    assert (start, end) == ((30.5, pytest.approx(30.0, abs=0.25)), None)
    assert snapped_ends(bar(30, 80), NOTHING, (30.5, 30.0), (30.5, 79.5))[1] is None
    # A line of a tenth of a pixel.
    assert snapped_ends(bar(30, 50), NOTHING, (30.5, 40.0), (30.5, 40.1)) == (None, None)


def test_pixels_that_were_not_received_are_no_background():
    image, missing = bar(30.0, 50.0), NOTHING.copy()
    missing[:, 50:] = True
    image[missing] = 0
    start, end = snapped_ends(image, missing, (30.5, 31.0), (30.5, 49.0))
    assert (start, end) == ((30.5, pytest.approx(30.0, abs=0.25)), None)
