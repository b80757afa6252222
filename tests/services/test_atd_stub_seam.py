"""atd_stub between two files: an object on the seam is one contact, whatever the cut, and nothing held is lost."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from builders.common import eventually
from builders.joined_surveys import RANGE_M, SAMPLES, START_S, Box, cut_into, held_of, near, run, survey_of
from builders.two_frequencies import with_second_frequency

from sonarpost import keys
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.seam import SeamLook, last_pings, pack, unpack
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.services.atd_stub.snippets import from_survey
from sonarpost.sonar.readers.xtf import read_xtf
from sonarpost.sonar.survey import ChannelPing, Ping, Side
from sonarpost.sonar.xtf_writer import write_xtf

KEY = keys.contact_detected("uuv-1")


@pytest.mark.parametrize("wait_s", [0.0, 30.0])
@pytest.mark.parametrize("cut", [100, 146, 149, 151, 155])
def test_an_object_is_found_once_wherever_the_recorder_cuts(cut, wait_s, tmp_path):
    survey = survey_of(300, Box(150))
    sent = run(cut_into(tmp_path, survey, (0, cut), (cut, 300)), join_timeout_s=wait_s)
    (found,) = near(sent, 150)
    assert len({s.contact.contact_id for s in sent}) == len(sent)
    if wait_s:
        # It waited for the rest of it: the object is in the middle of a whole picture.
        assert found.picture.height_px == 80
        bright = found.picture.to_array().astype(float)
        rows = bright[:, max(0, 70 - 20) :].max(axis=1)
        assert rows[36:44].mean() > 1.2 * np.r_[rows[:20], rows[-20:]].mean()
    number = 0 if found.contact.ping_number < cut else 1
    assert found.contact.line_name == found.source.removesuffix(".xtf") == f"line-{number}"


def test_what_lies_far_from_the_seam_does_not_wait(tmp_path):
    survey = survey_of(300, Box(100), Box(260, Side.STARBOARD))
    (path,) = cut_into(tmp_path, survey, (0, 300))
    found = from_survey(path, "0" * 64, "uuv-1", AtdStubConfig(join_timeout_s=30.0), {}, 100.0)
    assert near(list(found.snippets), 100)
    assert not near(list(found.snippets), 260, Side.STARBOARD)
    assert near(held_of(found.seam), 260, Side.STARBOARD)
    assert found.seam.until_utc_s == 130.0


def test_many_short_files_are_one_stream(tmp_path):
    survey = survey_of(250, Box(40), Box(100), Box(150, Side.STARBOARD), Box(199))
    spans = list(pairwise(range(0, 251, 50)))
    sent = run(cut_into(tmp_path, survey, *spans), join_timeout_s=30.0)
    for row, side in ((40, Side.PORT), (100, Side.PORT), (150, Side.STARBOARD), (199, Side.PORT)):
        assert len(near(sent, row, side)) == 1, row


@pytest.mark.parametrize("wait_s", [0.0, 30.0])
def test_pings_recorded_twice_are_looked_at_once(wait_s, tmp_path):
    survey = survey_of(300, Box(130), Box(100, Side.STARBOARD))
    sent = run(cut_into(tmp_path, survey, (0, 150), (90, 300)), join_timeout_s=wait_s)
    assert len(near(sent, 130)) == len(near(sent, 100, Side.STARBOARD)) == 1


def test_a_long_file_gives_each_object_once_whatever_strip_it_is_in(tmp_path):
    rows = [200, 780, 800, 885, 899, 901, 915, 985, 1000, 1600]
    sides = [Side.PORT, Side.STARBOARD]
    boxes = [Box(row, sides[n % 2]) for n, row in enumerate(rows)]
    (path,) = cut_into(tmp_path, survey_of(1700, *boxes), (0, 1700))
    sent = run([path])
    assert [len(near(sent, box.row, box.side)) for box in boxes] == [1] * len(boxes)


@pytest.mark.parametrize("what", ["later", "elsewhere", "other sonar", "other range", "earlier", "one more channel"])
def test_a_file_that_does_not_go_on_there_lets_what_waited_go(what, tmp_path):
    survey = survey_of(200, Box(97))
    first, second = cut_into(tmp_path, survey, (0, 100), (100, 200))
    later = survey.pings[100:]
    match what:
        case "later":
            later = tuple(replace(p, time_utc_s=p.time_utc_s + 5.0) for p in later)
        case "elsewhere":
            later = tuple(replace(p, lat_deg=p.lat_deg + 0.001) for p in later)
        case "other range":
            later = tuple(replace(p, channels=tuple(replace(c, slant_range_m=30.0) for c in p.channels)) for p in later)
        case "earlier":
            later = tuple(replace(p, time_utc_s=p.time_utc_s - 3600.0) for p in later)
        case "one more channel":
            later = with_second_frequency(replace(survey, pings=later), SAMPLES, RANGE_M).pings
    write_xtf(replace(survey, pings=later, sonar_id="else" if what == "other sonar" else "made"), second)
    config = AtdStubConfig(join_timeout_s=30.0)
    seam = from_survey(first, "0" * 64, "uuv-1", config, {}, 100.0).seam
    assert near(held_of(seam), 97)
    assert not from_survey(second, "1" * 64, "uuv-1", config, {seam.sonar_id: seam}, 100.0).joined


def test_a_clock_that_stands_still_merges_nothing(tmp_path):
    survey = survey_of(260, Box(60), Box(120), Box(200))
    stopped = replace(survey, pings=tuple(replace(p, time_utc_s=START_S) for p in survey.pings))
    sent = run(cut_into(tmp_path, stopped, (0, 260)))
    assert [len(near(sent, row)) for row in (60, 120, 200)] == [1, 1, 1]


def test_most_contacts_of_a_file_are_its_most_confident(tmp_path):
    (path,) = cut_into(tmp_path, survey_of(500, *(Box(row) for row in range(60, 460, 60))), (0, 500))
    everything = sorted(run([path]), key=lambda s: -s.contact.atd_confidence)
    few = run([path], max_contacts=3)
    assert [s.contact.contact_id for s in few] == [s.contact.contact_id for s in everything[:3]]


def test_a_seam_survives_the_store(tmp_path):
    (path,) = cut_into(tmp_path, survey_of(150, Box(130)), (0, 150))
    seam = from_survey(path, "0" * 64, "uuv-1", AtdStubConfig(join_timeout_s=30.0), {}, 100.0).seam
    again = unpack(pack(seam))
    assert (again.sonar_id, again.origins, again.looks, again.until_utc_s) == (
        seam.sonar_id,
        seam.origins,
        seam.looks,
        seam.until_utc_s,
    )
    assert again.held
    for one, other in zip(seam.pings, again.pings, strict=True):
        assert replace(one, channels=()) == replace(other, channels=())
        for mine, theirs in zip(one.channels, other.channels, strict=True):
            np.testing.assert_array_equal(mine.samples, theirs.samples)
            assert (mine.side, mine.samples.dtype, mine.slant_range_m, mine.scale) == (
                theirs.side,
                theirs.samples.dtype,
                theirs.slant_range_m,
                theirs.scale,
            )
    with pytest.raises(ValueError, match="format 2"):
        unpack(pack(seam).replace(b"\xa6format\x01", b"\xa6format\x02"))


def test_looks_are_one_object_only_side_by_side():
    look = SeamLook(Side.PORT, 50, 46, 54, 11.0, 0.1)
    assert look.is_same(look)
    assert look.is_same(replace(look, row=79, first_row=75, end_row=83))
    assert not look.is_same(replace(look, row=81, first_row=77, end_row=85))
    assert look.is_same(replace(look, row=90, first_row=53, end_row=127)), "one is seen whole"
    assert not look.is_same(replace(look, side=Side.STARBOARD))
    assert not look.is_same(replace(look, slant_range_m=14.1))


def test_a_seam_of_very_long_pings_is_short():
    ping = Ping(0, 0.0, (ChannelPing(Side.PORT, np.zeros(1 << 20, dtype=np.uint32), 10.0),))
    assert last_pings([ping] * 50, 200) == 4
    assert last_pings([ping] * 2, 200) == 2
    assert last_pings([], 200) == 0


# In the service


@pytest.fixture
def begin(runner, platform, tmp_path):
    (tmp_path / "incoming").mkdir(exist_ok=True)

    def start(**changes):
        config = AtdStubConfig(input_dir=tmp_path / "incoming", poll_s=0.02, settle_s=0.0, **changes)
        return runner.start(AtdStubService(platform("uuv-1"), config))

    return start


@pytest.fixture
def halves(tmp_path):
    """A line cut through an object, delivered file by file."""
    (tmp_path / "made").mkdir()
    paths = cut_into(tmp_path / "made", survey_of(240, Box(120)), (0, 119), (119, 240))

    def deliver(number: int) -> None:
        paths[number].rename(tmp_path / "incoming" / paths[number].name)

    return deliver


def processed(service):
    return service.health().counters.get("files_processed", 0)


@pytest.mark.parametrize("restarted", [False, True])
def test_a_contact_on_the_seam_waits_for_the_next_file_and_goes_once(restarted, begin, runner, halves):
    compressor = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    service = begin(join_timeout_s=3600.0)
    halves(0)
    eventually(lambda: processed(service) == 1)
    eventually(lambda: service.health().gauges["contacts_waiting"] >= 1)
    assert near(compressor.received, 120) == []
    if restarted:
        runner.stop(service)
        service = begin(join_timeout_s=3600.0)
        eventually(lambda service=service: service.health().gauges["contacts_waiting"] >= 1)
    halves(1)
    eventually(lambda: len(near(compressor.received, 120)) == 1)
    assert near(compressor.received, 120)[0].picture.height_px == 80


def test_a_contact_goes_as_it_is_when_no_file_comes(begin, runner, halves):
    compressor = runner.peer("uuv-1", "compressor", {KEY: Snippet})
    service = begin(join_timeout_s=0.2)
    halves(0)
    eventually(lambda: len(near(compressor.received, 120)) == 1)
    eventually(lambda: service.health().gauges["contacts_waiting"] == 0)
    halves(1)
    eventually(lambda: processed(service) == 2)
    eventually(lambda: service.health().gauges["contacts_waiting"] == service.health().gauges["outbox"] == 0)
    assert len(near(compressor.received, 120)) == 1, "it is known"


def test_read_back_the_pings_of_the_file_are_those_that_were_cut(tmp_path):
    """The makers of this file work: what they write is what is read."""
    survey = survey_of(60, Box(30))
    (path,) = cut_into(tmp_path, survey, (10, 50))
    read = read_xtf(path)
    assert [p.number for p in read.pings] == list(range(10, 50))
    np.testing.assert_array_equal(read.pings[0].channel(Side.PORT).samples, survey.pings[10].channel(Side.PORT).samples)
