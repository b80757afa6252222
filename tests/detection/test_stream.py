"""Detection over consecutive files."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest

from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import StreamDetector, is_continuation
from sonarpost.sonar.survey import ChannelPing, Side


def split(survey, *boundaries):
    """Return the survey as consecutive files that start at these pings."""
    edges = [0, *boundaries, len(survey.pings)]
    return [
        replace(survey, path=Path(f"{number}.xtf"), pings=survey.pings[first:last])
        for number, (first, last) in enumerate(itertools.pairwise(edges))
    ]


def contacts_of(files, settings=None):
    detector = StreamDetector(settings)
    found = [contact for survey in files for contact in detector.add_file(survey)]
    return [*found, *detector.finish()]


@pytest.mark.parametrize("boundary", [90, 98, 100, 103, 110])
def test_target_at_file_boundary_is_detected_once(make_survey, boundary):
    survey = make_survey({"ping": 100, "sample": 250})
    (expected,) = detect(survey)
    (found,) = contacts_of(split(survey, boundary))
    first = {Path("0.xtf"): 0, Path("1.xtf"): boundary}[found.path]
    assert first + found.ping == pytest.approx(expected.ping_index, abs=2)
    assert found.detection.sample == pytest.approx(expected.sample, abs=4)
    assert found.detection.length_m == pytest.approx(expected.length_m, abs=0.3)
    assert found.detection.confidence > 1.5
    assert found.survey.pings[found.detection.ping_index].number == 1000 + first + found.ping


def test_every_contact_of_a_line_is_returned_once(make_survey):
    survey = make_survey(
        {"ping": 30}, {"ping": 75, "sample": 330}, {"ping": 128}, {"ping": 180, "side": Side.STARBOARD}
    )
    files = split(survey, 70, 130)
    found = contacts_of(files)
    firsts = {Path("0.xtf"): 0, Path("1.xtf"): 70, Path("2.xtf"): 130}
    pings = sorted(firsts[c.path] + c.ping for c in found)
    assert pings == [pytest.approx(p, abs=3) for p in (30, 75, 128, 180)]


def test_contact_near_end_waits_for_next_file_or_end_of_line(make_survey):
    survey = make_survey({"ping": 60}, {"ping": 175})
    detector = StreamDetector()
    (early,) = detector.add_file(survey)
    assert early.ping == pytest.approx(60, abs=3)
    (late,) = detector.finish()
    assert late.ping == pytest.approx(175, abs=3)
    assert detector.finish() == ()
    other_sonar = replace(survey, sonar_id="another")
    detector.add_file(survey)
    assert sorted(c.ping for c in detector.add_file(other_sonar)) == [
        pytest.approx(60, abs=3),
        pytest.approx(175, abs=3),
    ]


def test_continuation_requires_same_sonar_sampling_and_time(make_survey):
    survey = make_survey()
    before, after = split(survey, 100)
    assert is_continuation(before, after)
    assert not is_continuation(after, before)
    assert not is_continuation(before, replace(after, sonar_id="another"))
    assert not is_continuation(before, replace(after, pings=()))
    late = tuple(replace(p, time_utc_s=p.time_utc_s + 60.0) for p in after.pings)
    assert not is_continuation(before, replace(after, pings=late))
    short = tuple(
        replace(p, channels=tuple(ChannelPing(c.side, c.samples[:300], c.slant_range_m) for c in p.channels))
        for p in after.pings
    )
    assert not is_continuation(before, replace(after, pings=short))


def test_file_shorter_than_overlap(make_survey):
    survey = make_survey({"ping": 100})
    settings = DetectorSettings()
    for boundaries in ((97, 103), (99, 100, 101)):
        found = contacts_of(split(survey, *boundaries), settings)
        firsts = {Path(f"{n}.xtf"): first for n, first in enumerate((0, *boundaries))}
        assert [firsts[c.path] + c.ping for c in found] == [pytest.approx(100, abs=3)], boundaries
