"""The streaming detector: each object is one contact at any boundary of strips and of files."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.two_frequencies import with_second_frequency
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.detection import candidates, stream
from sonarpost.detection.detector import SearchResult, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import FileOrigin, StreamDetector, stored_ping_count
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

pytestmark = pytest.mark.usefixtures("few_candidates")


@pytest.fixture(scope="module")
def template(one_object):
    """A detection, with 0.1 m between its pings."""
    return replace(one_object[1], pixel_along_m=0.1)


def split(survey, *boundaries):
    """Return the survey as consecutive files that start at these pings."""
    edges = [0, *boundaries, len(survey.pings)]
    return [
        replace(survey, path=Path(f"{number}.xtf"), line_name=str(number), pings=survey.pings[first:last])
        for number, (first, last) in enumerate(itertools.pairwise(edges))
    ]


def detector_of(settings=None, ends=None):
    """Return a detector of whose contacts the detection and the number of its ping are known."""
    return StreamDetector(lambda survey, d, origin: (survey.pings[d.ping_index].number, d), settings, ends)


def add(detector, survey):
    source = InMemorySource(survey, SurveyOptions())
    return detector.add_file(source, FileOrigin.of(source, survey.path.stem))


def contacts_of(files, settings=None):
    detector = detector_of(settings)
    results = [add(detector, survey) for survey in files]
    return [contact for r in results for contact in (*r.released, *r.contacts)] + list(detector.finish())


def numbers(contacts):
    return sorted(contact.content[0] - 1000 for contact in contacts)


@pytest.mark.parametrize("boundary", [90, 100, 103])
def test_target_at_file_boundary_is_detected_once(one_object, boundary):
    survey, expected = one_object
    (found,) = contacts_of(split(survey, boundary))
    number, detection = found.content
    assert number - 1000 == pytest.approx(expected.ping_index, abs=2)
    assert number == 1000 + found.origin.row + (boundary if found.origin.file.source == "1.xtf" else 0)
    assert detection.sample == pytest.approx(expected.sample, abs=4)
    assert detection.length_m == pytest.approx(expected.length_m, abs=0.3)
    assert detection.confidence == pytest.approx(expected.confidence, abs=0.01), "the joined pings are the same"
    line = found.origin.file.source[0]
    assert found.origin.file.contact_id(detection) == f"{line}-{line}-{number}-{detection.side}-{detection.sample}"


def test_every_contact_of_a_line_is_returned_once(make_survey):
    survey = make_survey(
        {"ping": 30}, {"ping": 75, "sample": 330}, {"ping": 128}, {"ping": 180, "side": Side.STARBOARD}
    )
    found = contacts_of(split(survey, 70, 130))
    assert numbers(found) == [pytest.approx(p, abs=3) for p in (30, 75, 128, 180)]


@pytest.mark.parametrize("boundaries", [(99, 100, 101), tuple(range(40, 200, 40))])
def test_files_shorter_than_the_overlap(one_object, boundaries):
    survey, expected = one_object
    (found,) = contacts_of(split(survey, *boundaries))
    assert found.content[0] - 1000 == pytest.approx(expected.ping_index, abs=3)


@pytest.mark.parametrize(("ping", "boundary"), [(79, ()), (101, ()), (120, (120,))])
def test_target_at_strip_boundary_is_detected_once(make_survey, monkeypatch, ping, boundary):
    monkeypatch.setattr(stream, "STRIP_PINGS", 60)
    settings = DetectorSettings(join_overlap_pings=40)
    survey = make_survey({"ping": ping}, sides=(Side.PORT,))
    (found,) = contacts_of(split(survey, *boundary), settings)
    assert found.content[0] - 1000 == pytest.approx(ping, abs=3)


@pytest.mark.parametrize("held", [True, False])
def test_an_end_restores_the_detector(make_survey, held):
    survey = make_survey({"ping": 40}, {"ping": 100}, sides=(Side.PORT,))
    files = split(survey, 99)
    detector = detector_of()
    first = add(detector, files[0])
    assert first.contacts == ()
    assert 39 <= numbers(first.held)[0] <= 41
    given = () if held else detector.release(survey.sonar_id)
    second = detector_of(ends=detector.ends)
    result = add(second, files[1])
    assert result.joined
    assert len(given) + len(result.contacts) + len(second.finish()) == 2
    assert {contact.content[0] for contact in (*result.replaced, *result.dropped)} == (
        {contact.content[0] for contact in first.held} if held else set()
    )


def test_contact_near_end_waits_for_next_file_or_end_of_line(make_survey):
    survey = make_survey({"ping": 60}, {"ping": 175}, sides=(Side.PORT,))
    detector = detector_of(DetectorSettings(join_overlap_pings=100))
    assert numbers(add(detector, survey).contacts) == [pytest.approx(60, abs=3)]
    assert numbers(detector.finish()) == [pytest.approx(175, abs=3)]
    assert detector.finish() == ()


def test_contacts_of_an_interrupted_recording_are_released(make_survey):
    survey = make_survey({"ping": 60}, {"ping": 175}, sides=(Side.PORT,))
    detector = detector_of()
    held = add(detector, survey).held
    other = add(detector, replace(survey, sonar_id="another"))
    assert (other.joined, other.released) == (False, ()), "files of two sonars may alternate"
    later = tuple(replace(p, time_utc_s=p.time_utc_s + 3600) for p in survey.pings)
    assert add(detector, replace(survey, pings=later)).released == held


def test_ends_of_at_most_eight_sonars_are_kept(one_object, monkeypatch):
    survey, found = one_object
    monkeypatch.setattr(stream, "search", lambda *_: SearchResult((found,), {}))
    detector = detector_of()
    results = [add(detector, replace(survey, sonar_id=f"sonar {n}")) for n in range(9)]
    assert [len(result.released) for result in results] == [0] * 8 + [1]
    assert list(detector.ends) == [f"sonar {n}" for n in range(1, 9)]


def test_a_contact_that_the_joined_pings_do_not_confirm_is_dropped(make_survey, monkeypatch):
    monkeypatch.setattr(candidates, "_MAX_PER_1000_PINGS", 100)
    files = split(make_survey({"ping": 98}), 100)
    detector = detector_of()
    held = add(detector, files[0]).held
    assert len(held) == 1
    strict = detector_of(DetectorSettings(confidence_threshold=2.0), detector.ends)
    result = add(strict, files[1])
    assert (result.dropped, result.replaced, result.contacts, strict.finish()) == (held, (), (), ())


def test_limit_applies_to_each_file_with_held_contacts(make_survey):
    survey = make_survey(*({"ping": ping, "sample": 200 + ping} for ping in (20, 60, 120, 180)))
    detector = detector_of(DetectorSettings(max_contacts=3, join_overlap_pings=100))
    result = add(detector, survey)
    best = detect(survey)[:3]
    given = [contact.content[1] for contact in (*result.contacts, *detector.finish())]
    assert sorted(d.ping_index for d in given) == sorted(d.ping_index for d in best)


# The part in the first file is not detected; the first file shows it whole; the part in the first file is reported.
@pytest.mark.parametrize(("seen", "reported", "count"), [(None, False, 1), ((40, 60), False, 0), (None, True, 0)])
def test_object_that_ends_beyond_a_file_is_taken_from_the_next(one_object, monkeypatch, seen, reported, count):
    survey, one = one_object
    rows = seen or (40, 130)
    whole = replace(one, ping_index=45, highlight_pings=rows)
    found = {100: (replace(whole, highlight_pings=(40, 60)),) if reported else (), 200: (whole,)}
    monkeypatch.setattr(stream, "search", lambda survey, *_: SearchResult(found[len(survey.pings)], {}))
    files = split(survey, 100)
    detector = detector_of(DetectorSettings(join_overlap_pings=100))
    assert len(add(detector, files[0]).contacts) == reported
    result = add(detector, files[1])
    assert len(result.contacts) + len(detector.finish()) == count


def with_channels(ping, change):
    return replace(ping, channels=tuple(change(channel) for channel in ping.channels))


@pytest.mark.parametrize(
    ("change", "continues"),
    [
        (lambda ping: ping, True),
        (lambda ping: replace(ping, time_utc_s=ping.time_utc_s + 60.0), False),
        (lambda ping: replace(ping, time_utc_s=ping.time_utc_s - 60.0), False),
        (lambda ping: replace(ping, lat_deg=ping.lat_deg + 0.001), False),
        (lambda ping: replace(ping, grid_m=(5e5, 6e6)), True),
        (lambda ping: with_channels(ping, lambda c: replace(c, samples=c.samples[:300])), False),
        (lambda ping: with_channels(ping, lambda c: replace(c, samples=c.samples.astype(np.uint32))), False),
        (lambda ping: with_channels(ping, lambda c: replace(c, slant_range_m=c.slant_range_m * 1.02)), False),
        (lambda ping: replace(ping, channels=ping.channels[:1]), False),
    ],
)
def test_continuation_requires_same_sampling_time_and_place(make_survey, monkeypatch, change, continues):
    monkeypatch.setattr(stream, "search", lambda *_: SearchResult((), {}))
    before, after = split(make_survey(), 100)
    detector = detector_of()
    add(detector, before)
    assert add(detector, replace(after, pings=tuple(map(change, after.pings)))).joined is continues


def test_another_frequency_is_no_continuation(make_survey, monkeypatch):
    monkeypatch.setattr(stream, "search", lambda *_: SearchResult((), {}))

    def at_frequency(survey, hz):
        return replace(
            survey, pings=tuple(with_channels(p, lambda c: replace(c, frequency_hz=hz)) for p in survey.pings)
        )

    before, after = split(make_survey(), 100)
    detector = detector_of()
    add(detector, at_frequency(before, 400e3))
    assert not add(detector, at_frequency(after, 900e3)).joined


@pytest.mark.parametrize("order", [1, -1])
def test_the_order_of_the_channels_of_two_frequencies_does_not_matter(make_survey, monkeypatch, order):
    monkeypatch.setattr(stream, "search", lambda *_: SearchResult((), {}))
    before, after = split(with_second_frequency(make_survey(), 512, 10.0), 100)
    detector = detector_of()
    add(detector, before)
    exchanged = tuple(replace(ping, channels=ping.channels[::order]) for ping in after.pings)
    assert add(detector, replace(after, pings=exchanged)).joined


def test_coordinates_in_metres_show_a_jump(make_survey, monkeypatch):
    monkeypatch.setattr(stream, "search", lambda *_: SearchResult((), {}))
    survey = make_survey()
    grid = tuple(
        replace(p, lat_deg=None, lon_deg=None, grid_m=(5e5, 6e6 + 0.1 * row + (40.0 if row >= 100 else 0.0)))
        for row, p in enumerate(survey.pings)
    )
    before, after = split(replace(survey, pings=grid), 100)
    detector = detector_of()
    add(detector, before)
    assert not add(detector, after).joined


def test_repeated_pings_are_left_out(one_object):
    survey, _ = one_object
    files = [replace(survey, pings=survey.pings[:120]), replace(survey, pings=survey.pings[80:])]
    assert len(contacts_of(files)) == 1


HALF_ROWS = 4


def visible_objects(template, objects):
    """Return a search that finds the visible part of each object of 8 rows, with a centre that differs by the strip."""

    def search(survey, *_):
        first, last = survey.pings[0].number, survey.pings[-1].number
        found = []
        for row, side in objects:
            begin, end = max(row - HALF_ROWS, first), min(row + HALF_ROWS, last + 1)
            if begin < end:
                centre = (begin + end) // 2 + (row + first + 3 * last) % 5 - 2
                index = min(max(centre, first), last) - first
                rows = (begin - first, end - first)
                found.append(replace(template, side=side, ping_index=index, highlight_pings=rows))
        return SearchResult(tuple(found), {})

    return search


@given(
    line=st.tuples(st.integers(60, 700), st.integers(38, 90), st.integers(0, 80)),
    boundaries=st.sets(st.integers(1, 699), max_size=8),
    overlap=st.integers(36, 120),
    strip=st.integers(50, 400),
    restored=st.booleans(),
)
def test_each_object_is_given_once_for_any_division(template, line, boundaries, overlap, strip, restored):
    rows, spacing, first = line
    objects = [(row, list(Side)[row % 2]) for row in range(first, rows, spacing)]
    channels = (ChannelPing(Side.PORT, np.zeros(4, np.uint8), 20.0),)
    pings = tuple(Ping(row, 0.1 * row, channels) for row in range(rows))
    files = split(Survey(Path("x.xtf"), "x", "x", pings), *sorted(row for row in boundaries if row < rows))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stream, "STRIP_PINGS", strip)
        patch.setattr(stream, "search", visible_objects(template, objects))
        detector = detector_of(DetectorSettings(join_overlap_pings=overlap))
        given_numbers = []
        for file in files:
            result = add(detector, file)
            given_numbers += [contact.content[0] for contact in result.contacts]
            assert result.released == ()
            if restored:
                detector = detector_of(DetectorSettings(join_overlap_pings=overlap), detector.ends)
        given_numbers += [contact.content[0] for contact in detector.finish()]
    assert len(given_numbers) == len(objects)
    for number, (row, _) in zip(sorted(given_numbers), objects, strict=True):
        assert abs(number - row) <= HALF_ROWS + 2


def test_the_end_of_a_recording_keeps_at_most_16_mib_of_samples():
    ping = Ping(0, 0.0, (ChannelPing(Side.PORT, np.zeros(1 << 20, dtype=np.uint32), 10.0),))
    assert stored_ping_count([ping] * 50, 200) == 4
    assert stored_ping_count([ping] * 2, 200) == 2
    assert stored_ping_count([], 200) == 0
