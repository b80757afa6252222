"""atd_stub between two files: an object on the seam is one contact, whatever the cut, and nothing held is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import eventually

from services.atd_stub.config import AtdStubConfig
from services.atd_stub.seam import SeamLook, last_pings, pack, unpack
from services.atd_stub.service import AtdStubService
from services.atd_stub.snippets import from_survey
from sonarpost import keys, wire
from sonarpost.detect.line import follows
from sonarpost.messages import Snippet
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey
from sonarpost.sonar.xtf_reader import read_xtf
from sonarpost.sonar.xtf_writer import write_xtf

KEY = keys.contact_detected("uuv-1")
START_S, PING_S, SAMPLES, RANGE_M, ALTITUDE_M, ALONG_M = 1.0e9, 0.1, 256, 20.0, 3.0, 0.1
OBJECT_SAMPLE = 150


@dataclass(frozen=True)
class Box:
    """A bright box of 8 pings and 10 samples, and its shadow, about a row."""

    row: int
    side: Side = Side.PORT


def survey_of(rows: int, *boxes: Box, seed: int = 5, first_row: int = 0) -> Survey:
    """Return a seabed of speckle with boxes; row 0 of the whole is at START_S."""
    rng = np.random.default_rng(seed)
    images = {}
    for side in Side:
        mean = np.ones((rows, SAMPLES))
        for box in boxes:
            if box.side is side:
                span = slice(box.row - 4, box.row + 4)
                mean[span, OBJECT_SAMPLE - 5 : OBJECT_SAMPLE + 5] = 6.0
                mean[span, OBJECT_SAMPLE + 5 : OBJECT_SAMPLE + 30] = 0.04
        ranges = (np.arange(SAMPLES) + 0.5) * RANGE_M / SAMPLES
        mean *= 1.0 / (1.0 + ranges / 8.0)
        mean[:, ranges < ALTITUDE_M] = 0.004
        images[side] = np.clip(mean * rng.rayleigh(0.8, mean.shape) * 4000, 0, 65535).astype(np.uint16)
    pings = tuple(
        Ping(
            number=row,
            time_utc_s=START_S + row * PING_S,
            channels=tuple(ChannelPing(side, images[side][row], RANGE_M) for side in Side),
            lat_deg=60.0 + row * ALONG_M / 111_412.0,
            lon_deg=5.0,
            heading_deg=0.0,
            altitude_m=ALTITUDE_M,
            depth_m=12.0,
            speed_mps=ALONG_M / PING_S,
        )
        for row in range(first_row, rows)
    )
    return Survey(Path("made.xtf"), "made", "made", pings)


def with_second_frequency(survey: Survey, samples: int, range_m: float) -> Survey:
    """Return a recording of a sonar of two frequencies: after each side's channel another, which shows mere speckle."""
    rng = np.random.default_rng(9)

    def channels(ping: Ping) -> tuple[ChannelPing, ...]:
        noise = {side: (rng.rayleigh(0.8, samples) * 2000).astype(np.uint16) for side in Side}
        high = (ChannelPing(side, noise[side], range_m, 900e3) for side in Side)
        return (*(replace(c, frequency_hz=400e3) for c in ping.channels), *high)

    return replace(survey, pings=tuple(replace(ping, channels=channels(ping)) for ping in survey.pings))


def cut_into(folder: Path, survey: Survey, *spans: tuple[int, int], sonar: str = "") -> list[Path]:
    """Write pieces of a survey as files of a recorder that begins a new one now and then."""
    paths = []
    for number, (first, end) in enumerate(spans):
        part = replace(survey, pings=survey.pings[first:end], sonar_id=sonar or survey.sonar_id)
        paths.append(folder / f"line-{number}.xtf")
        write_xtf(part, paths[-1])
    return paths


def run(paths: list[Path], **changes) -> list[Snippet]:
    """Return what files give that come one after the other, and what is still held when no other comes."""
    config = AtdStubConfig(**changes)
    seams, sent, total = {}, [], 0
    for path in paths:
        found = from_survey(path, path.stem.ljust(64, "0"), "uuv-1", config, seams, 100.0)
        if not found.joined:
            sent += [payload for seam in seams.values() for payload in held_of(seam)]
        sent += found.snippets
        total += found.contacts
        seams = {} if found.seam is None else {found.seam.sonar_id: found.seam}
    sent += [snippet for seam in seams.values() for snippet in held_of(seam)]
    assert len(sent) == total, "every contact is counted once"
    return sent


def held_of(seam) -> list[Snippet]:
    return [wire.decode(Snippet, payload, "held") for payload in seam.held]


def near(sent: list[Snippet], row: int, side: Side = Side.PORT) -> list[Snippet]:
    """Return the contacts within a metre of a box."""
    slant_m = OBJECT_SAMPLE * RANGE_M / SAMPLES
    return [
        s
        for s in sent
        if s.contact.channel == side.value
        and abs(s.contact.ping_number - row) <= 10
        and abs(s.contact.slant_range_m - slant_m) < 1.0
    ]


@pytest.mark.parametrize("wait_s", [0.0, 30.0])
@pytest.mark.parametrize("cut", [100, 146, 149, 151, 155])
def test_an_object_is_found_once_wherever_the_recorder_cuts(cut, wait_s, tmp_path):
    survey = survey_of(300, Box(150))
    sent = run(cut_into(tmp_path, survey, (0, cut), (cut, 300)), seam_wait_s=wait_s)
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
    found = from_survey(path, "0" * 64, "uuv-1", AtdStubConfig(seam_wait_s=30.0), {}, 100.0)
    assert near(list(found.snippets), 100)
    assert not near(list(found.snippets), 260, Side.STARBOARD)
    assert near(held_of(found.seam), 260, Side.STARBOARD)
    assert found.seam.until_utc_s == 130.0


def test_many_short_files_are_one_stream(tmp_path):
    survey = survey_of(250, Box(40), Box(100), Box(150, Side.STARBOARD), Box(199))
    spans = list(pairwise(range(0, 251, 50)))
    sent = run(cut_into(tmp_path, survey, *spans), seam_wait_s=30.0)
    for row, side in ((40, Side.PORT), (100, Side.PORT), (150, Side.STARBOARD), (199, Side.PORT)):
        assert len(near(sent, row, side)) == 1, row


@pytest.mark.parametrize("wait_s", [0.0, 30.0])
def test_pings_recorded_twice_are_looked_at_once(wait_s, tmp_path):
    survey = survey_of(300, Box(130), Box(100, Side.STARBOARD))
    sent = run(cut_into(tmp_path, survey, (0, 150), (90, 300)), seam_wait_s=wait_s)
    assert len(near(sent, 130)) == len(near(sent, 100, Side.STARBOARD)) == 1


def test_a_long_file_gives_each_object_once_whatever_strip_it_is_in(tmp_path):
    rows = [200, 780, 800, 885, 899, 901, 915, 985, 1000, 1600]
    sides = [Side.PORT, Side.STARBOARD]
    boxes = [Box(row, sides[n % 2]) for n, row in enumerate(rows)]
    (path,) = cut_into(tmp_path, survey_of(1700, *boxes), (0, 1700))
    sent = run([path])
    assert [len(near(sent, box.row, box.side)) for box in boxes] == [1] * len(boxes)


@pytest.mark.parametrize(("samples", "range_m"), [(SAMPLES, RANGE_M), (SAMPLES // 2, RANGE_M), (320, 12.5)])
def test_files_of_two_frequencies_go_on_where_the_one_before_ended(samples, range_m, tmp_path):
    survey = with_second_frequency(survey_of(300, Box(150)), samples, range_m)
    paths = cut_into(tmp_path, survey, (0, 149), (149, 300))
    read = [read_xtf(path) for path in paths]
    assert [len(ping.channels) for ping in (read[0].pings[-1], read[1].pings[0])] == [4, 4]
    assert follows(*read), "commands join them"
    assert len(near(run(paths, seam_wait_s=30.0), 150)) == 1
    seam = from_survey(paths[0], "0" * 64, "uuv-1", AtdStubConfig(seam_wait_s=30.0), {}, 100.0).seam
    assert from_survey(paths[1], "1" * 64, "uuv-1", AtdStubConfig(), {seam.sonar_id: unpack(pack(seam))}, 100.0).joined


def test_a_second_frequency_with_another_range_is_not_the_same_recording(tmp_path):
    survey = survey_of(200, Box(97))
    before, after = (with_second_frequency(survey, 320, range_m) for range_m in (12.5, 10.0))
    first, second = cut_into(tmp_path, before, (0, 100), (100, 200))
    write_xtf(replace(after, pings=after.pings[100:]), second)
    assert not follows(read_xtf(first), read_xtf(second))
    seam = from_survey(first, "0" * 64, "uuv-1", AtdStubConfig(), {}, 100.0).seam
    assert not from_survey(second, "1" * 64, "uuv-1", AtdStubConfig(), {seam.sonar_id: seam}, 100.0).joined


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
    config = AtdStubConfig(seam_wait_s=30.0)
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
    seam = from_survey(path, "0" * 64, "uuv-1", AtdStubConfig(seam_wait_s=30.0), {}, 100.0).seam
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
def begin(crew, platform, tmp_path):
    (tmp_path / "incoming").mkdir(exist_ok=True)

    def start(**changes):
        config = AtdStubConfig(input_dir=tmp_path / "incoming", poll_s=0.02, settle_s=0.0, **changes)
        return crew.start(AtdStubService(platform("uuv-1"), config))

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
def test_a_contact_on_the_seam_waits_for_the_next_file_and_goes_once(restarted, begin, crew, halves):
    compressor = crew.neighbour("uuv-1", "compressor", {KEY: Snippet})
    service = begin(seam_wait_s=3600.0)
    halves(0)
    eventually(lambda: processed(service) == 1)
    eventually(lambda: service.health().gauges["contacts_waiting"] >= 1)
    assert near(compressor.got, 120) == []
    if restarted:
        crew.stop(service)
        service = begin(seam_wait_s=3600.0)
        eventually(lambda service=service: service.health().gauges["contacts_waiting"] >= 1)
    halves(1)
    eventually(lambda: len(near(compressor.got, 120)) == 1)
    assert near(compressor.got, 120)[0].picture.height_px == 80


def test_a_contact_goes_as_it_is_when_no_file_comes(begin, crew, halves):
    compressor = crew.neighbour("uuv-1", "compressor", {KEY: Snippet})
    service = begin(seam_wait_s=0.2)
    halves(0)
    eventually(lambda: len(near(compressor.got, 120)) == 1)
    eventually(lambda: service.health().gauges["contacts_waiting"] == 0)
    halves(1)
    eventually(lambda: processed(service) == 2)
    eventually(lambda: service.health().gauges["contacts_waiting"] == service.health().gauges["outbox"] == 0)
    assert len(near(compressor.got, 120)) == 1, "it is known"


def test_read_back_the_pings_of_the_file_are_those_that_were_cut(tmp_path):
    """The makers of this file work: what they write is what is read."""
    survey = survey_of(60, Box(30))
    (path,) = cut_into(tmp_path, survey, (10, 50))
    read = read_xtf(path)
    assert [p.number for p in read.pings] == list(range(10, 50))
    np.testing.assert_array_equal(read.pings[0].channel(Side.PORT).samples, survey.pings[10].channel(Side.PORT).samples)
