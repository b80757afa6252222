"""atd_stub at file boundaries: an object across two files is one contact, and no held contact is lost."""

from dataclasses import replace
from itertools import pairwise

import msgpack
import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER, eventually
from builders.joined_surveys import (
    FEW_CANDIDATES,
    START_S,
    Box,
    detect_in_files,
    near,
    split,
    survey_of,
)
from builders.xtf import write_xtf

from sonarpost import wire
from sonarpost.detection.association import DetectionPlace
from sonarpost.detection.settings import DetectorTuning
from sonarpost.detection.stream import FileOrigin, PingOrigin, StreamContact, StreamEnd
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.file_boundary import StoredEnd, pack, unpack
from sonarpost.services.atd_stub.survey_detection import detect_in_survey
from sonarpost.sonar.survey import Side

GOLDEN = GOLDEN_FOLDER / "atd_stub"
HOLDING = AtdStubConfig(join_timeout_s=30.0)


@pytest.mark.parametrize(("boundary", "wait_s"), [(100, 30.0), (146, 30.0), (149, 0.0), (151, 30.0)])
def test_an_object_is_one_contact_at_any_file_boundary(boundary, wait_s, tmp_path):
    survey = survey_of(300, Box(150))
    sent = detect_in_files(split(tmp_path, survey, (0, boundary), (boundary, 300)), join_timeout_s=wait_s)
    (snippet,) = near(sent, 150)
    assert len({s.contact.contact_id for s in sent}) == len(sent)
    if wait_s:
        # It waited for the continuation file: the object is in the middle of a complete image.
        assert snippet.pixels.height_px == 80
        bright = snippet.pixels.to_array().astype(float)
        rows = bright[:, 67:73].mean(axis=1)
        assert rows[36:44].mean() < 0.2 * np.r_[rows[:20], rows[-20:]].mean()
    number = 0 if snippet.contact.ping_number < boundary else 1
    assert snippet.contact.line_name == snippet.source.removesuffix(".xtf") == f"line-{number}"


def test_contacts_far_from_the_boundary_are_not_held(tmp_path):
    survey = survey_of(300, Box(100), Box(260, Side.STARBOARD))
    (path,) = split(tmp_path, survey, (0, 300))
    result = detect_in_survey(path, "0" * 64, "uuv-1", HOLDING)
    assert near(list(result.snippets), 100)
    assert not near(list(result.snippets), 260, Side.STARBOARD)
    assert near(list(result.held), 260, Side.STARBOARD)


def test_short_files_are_joined(tmp_path):
    survey = survey_of(250, Box(40), Box(100), Box(150, Side.STARBOARD), Box(199))
    spans = list(pairwise(range(0, 251, 50)))
    sent = detect_in_files(split(tmp_path, survey, *spans), join_timeout_s=30.0)
    for row, side in ((40, Side.PORT), (100, Side.PORT), (150, Side.STARBOARD), (199, Side.PORT)):
        assert len(near(sent, row, side)) == 1, row


@pytest.mark.parametrize("wait_s", [0.0, 30.0])
def test_repeated_pings_are_searched_once(wait_s, tmp_path):
    survey = survey_of(300, Box(130), Box(100, Side.STARBOARD))
    sent = detect_in_files(split(tmp_path, survey, (0, 150), (90, 300)), join_timeout_s=wait_s)
    assert len(near(sent, 130)) == len(near(sent, 100, Side.STARBOARD)) == 1


def test_each_object_of_a_long_file_is_one_contact_in_any_strip(tmp_path):
    rows = [200, 780, 800, 860, 899, 901, 940, 985, 1000, 1600]
    sides = [Side.PORT, Side.STARBOARD]
    boxes = [Box(row, sides[n % 2]) for n, row in enumerate(rows)]
    (path,) = split(tmp_path, survey_of(1700, *boxes), (0, 1700))
    sent = detect_in_files([path], detector=FEW_CANDIDATES)
    assert [len(near(sent, box.row, box.side)) for box in boxes] == [1] * len(boxes)


def at_frequency(ping, frequency_hz):
    return replace(ping, channels=tuple(replace(c, frequency_hz=frequency_hz) for c in ping.channels))


@pytest.mark.parametrize("what", ["later", "elsewhere", "other sonar", "other range", "earlier", "other frequency"])
def test_a_file_that_is_no_continuation_is_not_joined(what, tmp_path):
    survey = survey_of(200, Box(97))
    first, second = split(tmp_path, survey, (0, 100), (100, 200))
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
        case "other frequency":
            written = replace(survey, pings=tuple(at_frequency(p, 400e3) for p in survey.pings[:100]))
            write_xtf(replace(written, sonar_id="made"), first)
            later = tuple(at_frequency(p, 900e3) for p in later)
    write_xtf(replace(survey, pings=later, sonar_id="else" if what == "other sonar" else "made"), second)
    before = detect_in_survey(first, "0" * 64, "uuv-1", HOLDING)
    assert near(list(before.held), 97)
    after = detect_in_survey(second, "1" * 64, "uuv-1", HOLDING, before.ends)
    assert not after.joined
    assert bool(near(list(after.not_continued), 97)) is (what != "other sonar")


def test_a_stopped_clock_does_not_merge_contacts(tmp_path):
    survey = survey_of(260, Box(60), Box(120), Box(200))
    stopped = replace(survey, pings=tuple(replace(p, time_utc_s=START_S) for p in survey.pings))
    sent = detect_in_files(split(tmp_path, stopped, (0, 260)), detector=FEW_CANDIDATES)
    assert [len(near(sent, row)) for row in (60, 120, 200)] == [1, 1, 1]


def test_max_contacts_keeps_the_most_confident(tmp_path):
    (path,) = split(tmp_path, survey_of(500, *(Box(row) for row in range(60, 460, 60))), (0, 500))
    every_contact = sorted(detect_in_files([path], detector=FEW_CANDIDATES), key=lambda s: -s.contact.atd_confidence)
    limited = detect_in_files([path], max_contacts=3, detector=FEW_CANDIDATES)
    assert [s.contact.contact_id for s in limited] == [s.contact.contact_id for s in every_contact[:3]]


def test_a_file_end_is_restored_from_the_store(tmp_path):
    (path,) = split(tmp_path, survey_of(250, Box(130), Box(200)), (0, 250))
    [end] = detect_in_survey(path, "0" * 64, "uuv-1", HOLDING).ends.values()
    packed = pack(StoredEnd(end, 130.0))
    restored = unpack(packed)
    assert restored.hold_until_utc_s == 130.0
    assert restored.end.held
    assert replace(restored.end, pings=()) == replace(end, pings=())
    assert len(restored.end.pings) == len(end.pings)
    assert pack(restored) == packed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda fields: fields | {"format": 3}, "format: got 3, expected 2"),
        (lambda fields: fields | {"format": 1}, "format: got 1, expected 2"),
        (lambda fields: {"format": 2}, "content: got KeyError"),
        (lambda fields: fields | {"origins": [[7, 0]]}, "content: got IndexError"),
        (lambda fields: fields | {"held": [[1]]}, "got"),
        (lambda fields: [1, 2], "content: got TypeError"),
    ],
)
def test_an_unreadable_file_end_is_one_error(change, message):
    fields = msgpack.unpackb(bytes.fromhex((GOLDEN / "seam-format-2.hex").read_text()))
    with pytest.raises(ValueError, match=message):
        unpack(msgpack.packb(change(fields)))


FIRST, SECOND = FileOrigin("0a" * 32, "line-0.xtf", "line-0"), FileOrigin("1b" * 32, "line-1.xtf", "line-1")


def test_a_stored_file_end_is_read_and_written_unchanged():
    contact = Contact(contact_id="line-1-1b1b1b1b-99-starboard-3", vehicle_id="uuv-1")
    snippet = Snippet(contact=contact, pixels=Pixels.from_array(np.zeros((16, 16), np.uint8)), source="line-1.xtf")
    fields = msgpack.unpackb(bytes.fromhex((GOLDEN / "seam-format-2.hex").read_text()))
    fields["held"][0][1] = wire.encode(snippet)
    packed = msgpack.packb(fields)
    stored = unpack(packed)
    held = DetectionPlace(Side.STARBOARD, 1, 0, 3, 12.5, 12.0, 14.25, 0.125)
    assert stored.hold_until_utc_s == 1.0e9 + 30.0
    assert replace(stored.end, pings=()) == StreamEnd(
        sonar_id="made",
        pings=(),
        origins=(PingOrigin(FIRST, 98), PingOrigin(FIRST, 99), PingOrigin(SECOND, 0)),
        open_row=1,
        reported=(DetectionPlace(Side.PORT, -2, -5, 1, 11.25, 11.0, 13.5, 0.2),),
        held=(StreamContact(PingOrigin(FIRST, 99), held, snippet),),
    )
    pings = stored.end.pings
    assert [ping.number for ping in pings] == [98, 99, 100]
    assert [ping.grid_m for ping in pings] == [None, None, (500_000.25, 6_651_000.5)]
    assert (pings[0].pitch_deg, pings[0].roll_deg, pings[1].lat_deg) == (0.5, -0.25, None)
    starboard = pings[2].channel(Side.STARBOARD)
    assert (starboard.frequency_hz, starboard.scale, starboard.samples.dtype) == (600e3, 0.5, np.uint16)
    np.testing.assert_array_equal(starboard.samples, [7, 8, 65535])
    assert pack(stored) == packed


# The service


@pytest.fixture
def start_service(start_service):
    """Half an object is a weak candidate."""
    return lambda **options: start_service(detector=DetectorTuning(), **options)


@pytest.fixture
def halves(tmp_path, incoming):
    """A line whose file boundary is at an object, delivered file by file."""
    (tmp_path / "made").mkdir()
    paths = split(tmp_path / "made", survey_of(240, Box(120)), (0, 119), (119, 240))
    return lambda number: paths[number].rename(incoming / paths[number].name)


@pytest.mark.parametrize("restarted", [False, True])
def test_a_contact_at_the_boundary_waits_for_the_continuation_file_and_is_sent_once(
    restarted, start_service, runner, compressor, halves, lines
):
    service = start_service(join_timeout_s=3600.0)
    halves(0)
    eventually(lambda: lines("Contact held for continuation file"))
    [held] = lines("Contact held for continuation file")
    assert (held["wait_s"], held["file"]) == (3600.0, "line-0.xtf")
    assert held["contact_id"].startswith("line-0-")
    if restarted:
        runner.stop(service)
        service = start_service(join_timeout_s=3600.0)
    health = service.health()
    assert (health.gauges["contacts_waiting"], health.gauges["contacts_held"]) == (1, 1)
    assert "1 contacts held for a continuation file until " in health.detail
    halves(1)
    eventually(lambda: lines("Held contact released"))
    assert lines("Held contact released") == [{"contact_id": held["contact_id"], "reason": "seen whole in line-1.xtf"}]
    eventually(lambda: near(compressor.received, 120))
    gauges = lambda: service.health().gauges  # noqa: E731
    eventually(lambda: gauges()["contacts_waiting"] == gauges()["contacts_held"] and gauges()["outbox"] == 0)
    [snippet] = near(compressor.received, 120)
    assert snippet.pixels.height_px == 80


@pytest.mark.parametrize(
    ("wait_s", "reason"), [(0.2, "no continuation file within 0.2 s"), (3600.0, "not continued by")]
)
def test_a_held_contact_without_a_continuation_is_released_and_later_recognised(
    wait_s, reason, start_service, compressor, halves, incoming, lines, counter
):
    service = start_service(join_timeout_s=wait_s)
    halves(0)
    eventually(lambda: counter(service, "files_processed") == 1)
    if wait_s > 1:
        later = survey_of(120, seed=9)
        later = replace(later, pings=tuple(replace(p, time_utc_s=p.time_utc_s + 7200) for p in later.pings))
        write_xtf(later, incoming / "other.xtf")
    eventually(lambda: lines("Held contact released"))
    [released] = lines("Held contact released")
    assert released["reason"].startswith(reason)
    eventually(lambda: len(near(compressor.received, 120)) == 1)
    assert released["contact_id"] == near(compressor.received, 120)[0].contact.contact_id
    if wait_s < 1:
        eventually(lambda: service.health().gauges["contacts_waiting"] == 0)
        halves(1)
        eventually(lambda: counter(service, "files_processed") == 2)
        eventually(lambda: service.health().gauges["contacts_waiting"] == service.health().gauges["outbox"] == 0)
        assert len(near(compressor.received, 120)) == 1, "the second search recognises it"


def test_a_held_contact_that_the_joined_pings_do_not_confirm_is_dropped(tmp_path):
    first, second = split(tmp_path, survey_of(240, Box(118)), (0, 120), (120, 240))
    before = detect_in_survey(first, "0" * 64, "uuv-1", HOLDING)
    [held] = before.held
    strict = HOLDING.model_copy(update={"confidence_threshold": 2.0})
    result = detect_in_survey(second, "1" * 64, "uuv-1", strict, before.ends)
    assert (result.dropped, result.snippets) == ((held,), ())


@pytest.mark.parametrize("pings", [300, pytest.param(1700, marks=pytest.mark.system)])
def test_counts_at_lower_thresholds_are_logged(pings, tmp_path, start_service, incoming, lines):
    spec = SurveySpec(seed=2, seabed=SeabedKind.ROCK, pings=pings, samples=400, targets=2, clutter=4)
    path = tmp_path / "rock.xtf"
    write_xtf(simulate_survey(spec).survey, path)
    result = detect_in_survey(path, "0" * 64, "uuv-1", AtdStubConfig(confidence_threshold=2.0))
    assert result.contact_count == 0
    assert list(result.weaker) == [1.0, 0.5, 0.3, 0.1]
    assert result.weaker[0.1] > result.weaker[0.3] > result.weaker[1.0] >= 1
    for confidence in (1.0, 0.3):
        found = detect_in_survey(path, "0" * 64, "uuv-1", AtdStubConfig(confidence_threshold=confidence))
        # Approximate where parts of a long file overlap.
        assert result.weaker[confidence] == pytest.approx(found.contact_count, abs=0 if pings <= 1000 else 2)
    if pings > 1000:
        return
    start_service(confidence_threshold=2.0)
    path.rename(incoming / path.name)
    eventually(lambda: lines("File processed"))
    weaker = ", ".join(f"{count} above {confidence}" for confidence, count in result.weaker.items())
    assert lines("File processed")[0]["counts"] == f"0 contacts above 2.0; {weaker}"
