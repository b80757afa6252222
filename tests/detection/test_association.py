"""Association of detections from overlapping windows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sonarpost.detection.association import DEFAULT_ROW_SPACING_M, DetectionPosition
from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side

POSITION = DetectionPosition(Side.PORT, 50, 46, 54, 11.0, 0.1)


@pytest.mark.parametrize("overlapping", [True, False])
def test_near_requires_both_distances_and_same_side(overlapping):
    def near(one, other):
        return one.is_near(other, 2.0, 1.5, overlapping=overlapping)

    farther_out = replace(POSITION, slant_range_m=12.25)
    assert near(POSITION, farther_out.shifted(19))
    assert not near(POSITION, farther_out.shifted(20))
    assert not near(POSITION, farther_out.shifted(-20))
    assert not near(POSITION, replace(POSITION, slant_range_m=12.5))
    assert not near(POSITION, replace(POSITION, side=Side.STARBOARD))
    coarser = replace(POSITION, along_m=0.2)
    assert not near(coarser, POSITION.shifted(10)), "the row spacing of the first position applies"
    assert near(POSITION.shifted(10), coarser)


def test_overlapping_rows_are_near_only_if_enabled():
    extended = replace(POSITION, row=90, first_row=53, end_row=127)
    assert POSITION.is_near(extended, 3.0, 3.0, overlapping=True)
    assert not POSITION.is_near(extended, 3.0, 3.0)
    assert not POSITION.is_near(replace(extended, first_row=54), 3.0, 3.0, overlapping=True)
    assert not POSITION.is_near(replace(extended, slant_range_m=14.0), 3.0, 3.0, overlapping=True)


def test_position_of_detection_in_stream(make_survey):
    (found,) = detect(make_survey({}))
    position = DetectionPosition.of_detection(found, 1000)
    assert (position.side, position.row, position.slant_range_m) == (
        found.side,
        1000 + found.ping_index,
        found.slant_range_m,
    )
    assert (position.first_row, position.end_row) == tuple(1000 + ping for ping in found.highlight_pings)
    assert position.along_m == found.pixel_along_m
    assert position.shifted(-1000) == DetectionPosition.of_detection(found)


def test_default_row_spacing_without_navigation(make_survey):
    (found,) = detect(make_survey({}, navigation=False))
    assert (
        DetectionPosition.of_detection(found).along_m == DEFAULT_ROW_SPACING_M == DetectorSettings().assumed_row_along_m
    )
    assert DetectionPosition.of_detection(found, default_along_m=0.5).along_m == 0.5
