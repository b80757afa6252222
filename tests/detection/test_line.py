from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest

from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import StreamDetector, is_continuation
from sonarpost.sonar.survey import ChannelPing, Side


def cut(survey, *seams):
    """The survey as a recorder that begins a new file at each of these pings writes it."""
    edges = [0, *seams, len(survey.pings)]
    return [
        replace(survey, path=Path(f"{number}.xtf"), pings=survey.pings[first:last])
        for number, (first, last) in enumerate(itertools.pairwise(edges))
    ]


def all_of(files, settings=None):
    detector = StreamDetector(settings)
    found = [contact for survey in files for contact in detector.add_file(survey)]
    return [*found, *detector.finish()]


def place(contact, first_ping):
    return first_ping + contact.ping, contact.detection.sample


@pytest.mark.parametrize("seam", [90, 98, 100, 103, 110])
def test_a_target_on_the_seam_is_found_once_where_it_lies(make_survey, seam):
    survey = make_survey({"ping": 100, "sample": 250})
    (whole,) = detect(survey)
    (found,) = all_of(cut(survey, seam))
    first = {Path("0.xtf"): 0, Path("1.xtf"): seam}[found.path]
    assert first + found.ping == pytest.approx(whole.ping_index, abs=2)
    assert found.detection.sample == pytest.approx(whole.sample, abs=4)
    assert found.detection.length_m == pytest.approx(whole.length_m, abs=0.3)
    assert found.detection.confidence > 1.5
    assert found.survey.pings[found.detection.ping_index].number == 1000 + first + found.ping


def test_every_contact_of_a_line_is_told_once_whatever_its_files(make_survey):
    survey = make_survey(
        {"ping": 30}, {"ping": 75, "sample": 330}, {"ping": 128}, {"ping": 180, "side": Side.STARBOARD}
    )
    files = cut(survey, 70, 130)
    found = all_of(files)
    firsts = {Path("0.xtf"): 0, Path("1.xtf"): 70, Path("2.xtf"): 130}
    pings = sorted(firsts[c.path] + c.ping for c in found)
    assert pings == [pytest.approx(p, abs=3) for p in (30, 75, 128, 180)]


def test_what_is_near_the_end_waits_for_the_next_file_or_the_end_of_the_line(make_survey):
    survey = make_survey({"ping": 60}, {"ping": 175})
    detector = StreamDetector()
    (early,) = detector.add_file(survey)
    assert early.ping == pytest.approx(60, abs=3)
    (late,) = detector.finish()
    assert late.ping == pytest.approx(175, abs=3)
    assert detector.finish() == ()
    stranger = replace(survey, sonar_id="another")
    detector.add_file(survey)
    assert sorted(c.ping for c in detector.add_file(stranger)) == [pytest.approx(60, abs=3), pytest.approx(175, abs=3)]


def test_a_file_follows_another_when_time_sonar_and_sampling_go_on(make_survey):
    survey = make_survey()
    before, after = cut(survey, 100)
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


def test_a_file_shorter_than_what_is_held_back_changes_nothing(make_survey):
    survey = make_survey({"ping": 100})
    settings = DetectorSettings()
    for seams in ((97, 103), (99, 100, 101)):
        found = all_of(cut(survey, *seams), settings)
        firsts = {Path(f"{n}.xtf"): first for n, first in enumerate((0, *seams))}
        assert [firsts[c.path] + c.ping for c in found] == [pytest.approx(100, abs=3)], seams
