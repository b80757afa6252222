"""Association of detections from overlapping parts of a recording."""

from dataclasses import replace

import pytest

from sonarpost.detection.association import DetectionPlace
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side

SETTINGS = DetectorSettings(separation_along_m=2.0, separation_across_m=1.5)
PLACE = DetectionPlace(Side.PORT, 50, 46, 54, 11.0, 10.8, 12.0, 0.1)


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (PLACE, True),
        (PLACE.shifted(19), True),
        (PLACE.shifted(20), False),
        (PLACE.shifted(-20), False),
        (replace(PLACE, slant_range_m=12.25).shifted(19), True),
        (replace(PLACE, slant_range_m=12.5).shifted(19), False),
        (replace(PLACE, side=Side.STARBOARD), False),
        # A common row of the highlights: one of them covers only a part of the object.
        (replace(PLACE, row=90, first_row=53, end_row=127), True),
        (replace(PLACE, row=90, first_row=54, end_row=127), False),
        # The other highlight begins in this shadow, or behind it.
        (replace(PLACE, row=90, first_row=53, end_row=127, slant_range_m=14.0, near_m=11.9, far_m=16.0), True),
        (replace(PLACE, row=90, first_row=53, end_row=127, slant_range_m=14.0, near_m=12.0, far_m=16.0), False),
    ],
)
def test_one_object(other, is_same):
    assert PLACE.is_same_object(other, SETTINGS) is is_same
    assert other.is_same_object(PLACE, SETTINGS) is is_same


def test_rows_are_compared_at_the_spacing_of_the_first_place():
    coarser = replace(PLACE, along_m=0.2)
    assert not coarser.is_same_object(PLACE.shifted(10), SETTINGS)
    assert PLACE.shifted(10).is_same_object(coarser, SETTINGS)


@pytest.mark.parametrize("pixel_along_m", [0.1, None])
def test_place_of_detection_in_stream(one_object, pixel_along_m):
    settings = DetectorSettings(assumed_row_along_m=0.5)
    found = replace(one_object[1], pixel_along_m=pixel_along_m)
    place = DetectionPlace.of_detection(found, settings, 1000)
    assert (place.side, place.row, place.slant_range_m) == (found.side, 1000 + found.ping_index, found.slant_range_m)
    assert (place.first_row, place.end_row) == tuple(1000 + ping for ping in found.highlight_pings)
    assert place.near_m < place.slant_range_m < place.near_m + found.width_m + 1e-9
    assert place.far_m == pytest.approx(place.near_m + found.width_m + found.shadow_m)
    assert place.along_m == (pixel_along_m or 0.5)
    assert place.shifted(-1000) == DetectionPlace.of_detection(found, settings)
