"""Which contacts of two looks are one object: near along and across, or, where that counts, in the same rows."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sonarpost.detection.association import DEFAULT_ROW_SPACING_M, AssociationRule, DetectionPosition
from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side

LOOK = DetectionPosition(Side.PORT, 50, 46, 54, 11.0, 0.1)


@pytest.mark.parametrize("overlapping", [True, False])
def test_near_is_nearer_than_both_limits_and_on_one_side(overlapping):
    sameness = AssociationRule(2.0, 1.5, overlapping)
    assert sameness.matches(LOOK, LOOK.shifted(19), 1.49)
    assert not sameness.matches(LOOK, LOOK.shifted(20), 1.49)
    assert not sameness.matches(LOOK, LOOK.shifted(-20), 1.49)
    assert not sameness.matches(LOOK, LOOK, 1.5)
    assert not sameness.matches(LOOK, replace(LOOK, side=Side.STARBOARD), 0.0)
    coarser = replace(LOOK, along_m=0.2)
    assert not sameness.matches(coarser, LOOK.shifted(10), 0.0), "the first one's travel counts"
    assert sameness.matches(LOOK.shifted(10), coarser, 0.0)


def test_rows_in_common_are_near_only_where_that_is_said():
    long = replace(LOOK, row=90, first_row=53, end_row=127)
    assert AssociationRule(3.0, 3.0, overlapping=True).matches(LOOK, long, 0.0)
    assert not AssociationRule(3.0, 3.0, overlapping=False).matches(LOOK, long, 0.0)
    assert not AssociationRule(3.0, 3.0, overlapping=True).matches(LOOK, replace(long, first_row=54), 0.0)
    assert not AssociationRule(3.0, 3.0, overlapping=True).matches(LOOK, long, 3.0)


def test_a_detection_is_a_look_in_the_stream_its_survey_lies_in(make_survey):
    (found,) = detect(make_survey({}))
    look = DetectionPosition.of_detection(found, 1000)
    assert (look.side, look.row, look.slant_range_m) == (found.side, 1000 + found.ping_index, found.slant_range_m)
    assert (look.first_row, look.end_row) == tuple(1000 + ping for ping in found.highlight_pings)
    assert look.along_m == found.pixel_along_m
    assert look.shifted(-1000) == DetectionPosition.of_detection(found)


def test_unknown_travel_is_the_detectors_own_or_what_is_given(make_survey):
    (found,) = detect(make_survey({}, navigation=False))
    assert (
        DetectionPosition.of_detection(found).along_m == DEFAULT_ROW_SPACING_M == DetectorSettings().assumed_row_along_m
    )
    assert DetectionPosition.of_detection(found, default_along_m=0.5).along_m == 0.5
