"""Picks of a person: syntax, place in the recording, measurement, and `sonarpost detect --pick`."""

import json
from dataclasses import replace

import pytest
from builders.xtf import write_xtf

from sonarpost.cli.main import main
from sonarpost.detection import picks as picks_module
from sonarpost.detection.detector import detect
from sonarpost.detection.picks import (
    MAX_PICKS,
    MAX_PICKS_BYTES,
    PICKED,
    Pick,
    is_at_detection,
    locate_picks,
    measure_picks,
    parse_pick,
    parse_picks,
    picks_text,
)
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import FileOrigin
from sonarpost.errors import ConfigError
from sonarpost.messages import Contact
from sonarpost.services.atd_stub.snippet_files import read_snippet
from sonarpost.sonar.image_files import read_image
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.side_car import read_side_car
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import Side

pytestmark = pytest.mark.usefixtures("few_candidates")

ORIGIN = FileOrigin("0" * 64, "made.xtf", "made")
DETECTOR = DetectorSettings()


@pytest.fixture(scope="module")
def survey(make_survey):
    """One object that the detector finds."""
    return make_survey({"side": Side.STARBOARD, "ping": 120})


@pytest.fixture(scope="module")
def file(survey, tmp_path_factory):
    path = tmp_path_factory.mktemp("picks") / "line7.xtf"
    write_xtf(survey, path)
    return path


def measured(survey, *texts, settings=DETECTOR):
    """Return picked detection, origin and survey row of each pick."""
    source = InMemorySource(survey, SurveyOptions())
    located, errors = locate_picks(source, [parse_pick(text, "test") for text in texts], "test")
    assert errors == ()
    return measure_picks(source, ORIGIN, located, lambda _, picked, origin: (picked, origin.row), settings)


def test_text_of_a_pick_is_what_was_parsed():
    for text in ("1120,port,300", "index:120,starboard,0"):
        assert str(parse_pick(text, "--pick")) == text
        assert parse_pick(f" {text.replace(',', ' , ')} ", "--pick") == parse_pick(text, "--pick")
    picks = (Pick(1, Side.PORT, 2), Pick(3, Side.STARBOARD, 4, by_index=True))
    assert parse_picks(picks_text(picks).encode(), "f") == (picks, ())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "--pick: place: got '', expected PING,SIDE,SAMPLE, for example 1120,port,300"),
        ("1,port", "--pick: place: got '1,port', expected PING"),
        ("1,port,2,3", "--pick: place: got"),
        ("x,port,2", "--pick: ping: got 'x', expected a whole number"),
        ("-1,port,2", "--pick: ping: got '-1', expected"),
        ("²,port,2", "--pick: ping: got '²', expected"),
        ("index:,port,2", "--pick: ping: got '', expected"),
        ("1,left,2", "--pick: side: got 'left', expected port or starboard"),
        ("1,port,2.5", "--pick: sample: got '2.5', expected"),
        (f"1,port,{'9' * 5000}", "--pick: sample: got '999"),
    ],
)
def test_error_names_the_invalid_part(text, message):
    with pytest.raises(ConfigError) as error:
        parse_pick(text, "--pick")
    assert str(error.value).startswith(message)
    assert "\n" not in str(error.value)


def test_invalid_lines_of_a_file_are_reported_and_the_others_used():
    content = b"\xef\xbb\xbf# by anna\r\n\r\n1,port,2\nnonsense\n1,port,2\n\xff\x00,port,3\n5,port,6\n"
    picks, errors = parse_picks(content, "f.picks")
    assert picks == (Pick(1, Side.PORT, 2), Pick(5, Side.PORT, 6))
    assert [error.where for error in errors] == ["f.picks line 4", "f.picks line 6"]
    # Number and size are limited.
    picks, errors = parse_picks(b"".join(b"%d,port,1\n" % n for n in range(MAX_PICKS + 9)), "f")
    assert (len(picks), len(errors)) == (MAX_PICKS, 1)
    assert parse_picks(b"1,port,2\n" * MAX_PICKS_BYTES, "f")[0] == ()


def test_pick_outside_the_recording_is_an_error(survey):
    source = InMemorySource(survey, SurveyOptions())
    texts = ["999,port,1", "index:200,port,1", "1000,port,512", "1000,port,511"]
    located, errors = locate_picks(source, [parse_pick(text, "--pick") for text in texts], "--pick")
    assert [each.row for each in located] == [0]
    assert [str(error) for error in errors] == [
        "--pick: ping: got 999, expected a ping number of the file, 1000 to 1199",
        "--pick: ping: got 200, expected an index from 0 to 199",
        "--pick: sample: got 512, expected 0 to 511",
    ]


def test_repeated_ping_number_needs_the_index_and_a_side_its_channel(survey):
    pings = tuple(replace(ping, number=ping.number % 50) for ping in survey.pings)
    source = InMemorySource(replace(survey, pings=pings), SurveyOptions())
    _, (error,) = locate_picks(source, [Pick(7, Side.PORT, 3)], "--pick")
    assert "index:7" in error.expected
    assert locate_picks(source, [Pick(107, Side.PORT, 3, by_index=True)], "--pick")[0][0].row == 107
    port = tuple(replace(ping, channels=ping.channels[:1]) for ping in survey.pings)
    source = InMemorySource(replace(survey, pings=port), SurveyOptions())
    _, (error,) = locate_picks(source, [Pick(1000, Side.STARBOARD, 3)], "--pick")
    assert error.field == "side"


def test_pick_on_a_detection_is_that_detection(survey):
    (detection,) = detect(survey)
    ((picked, row),) = measured(survey, f"{detection.ping_number},starboard,{detection.sample + 20}")
    assert picked.is_candidate
    assert (picked.detection, row) == (detection, detection.ping_index)
    record = picked.record(ORIGIN, "uuv-1", "made")
    assert (record.atd_class, record.atd_confidence) == (detection.atd_class, detection.confidence)


def test_missed_highlight_is_measured_at_the_pick(make_survey):
    highlight = {"side": Side.PORT, "ping": 60, "sample": 300, "shadow_samples": 0, "highlight": 4.0}
    survey = make_survey(highlight, sides=(Side.PORT,))
    ((picked, row),) = measured(survey, "1060,port,300", settings=DetectorSettings(min_matched_response=900.0))
    assert (picked.is_candidate, picked.is_measured) == (False, True)
    d = picked.detection
    assert abs(row - 60) <= 3
    assert abs(d.sample - 300) <= 6
    assert 0.4 <= d.length_m <= 1.6
    assert (d.atd_class, d.p_mine_like, d.p_other_object) == (PICKED, None, None)
    record = picked.record(ORIGIN, "uuv-1", "made")
    assert record.atd_confidence is None
    assert record.length_m == d.length_m
    assert record.lat_deg is not None


@pytest.mark.parametrize("text", ["1030,port,400", "1030,port,10", "1000,starboard,0", "1199,starboard,511"])
def test_place_where_nothing_is_measurable_has_unknown_sizes(survey, text):
    ((picked, row),) = measured(survey, text, settings=DetectorSettings(min_matched_response=900.0))
    record = picked.record(ORIGIN, "uuv-1", "made")
    if text == "1030,port,10":  # in the water column
        assert not picked.is_measured
        assert record.lat_deg is None
    assert Contact.model_validate(record.model_dump()) == record
    if picked.is_measured:  # speckle may exceed the seabed around
        return
    pick = parse_pick(text, "test")
    assert (row, picked.detection.sample) == (pick.ping - 1000, pick.sample)
    assert (record.length_m, record.width_m, record.shadow_m, record.height_m) == (None,) * 4
    assert (record.atd_class, record.ping_number, record.channel) == (PICKED, pick.ping, pick.side.value)


def test_picks_of_a_long_recording_are_those_of_a_short_one(survey, monkeypatch):
    """The strips in which picks are measured do not change place and order."""
    texts = ["index:190,port,300", "index:60,port,300", "index:120,starboard,250", "index:99,port,20"]
    whole = measured(survey, *texts)
    monkeypatch.setattr(picks_module, "STRIP_PINGS", 100)
    parts = measured(survey, *texts, settings=DetectorSettings(join_overlap_pings=20))
    for (one, row), (other, other_row) in zip(whole, parts, strict=True):
        assert abs(row - other_row) <= 3
        assert one.detection.side is other.detection.side
        assert abs(one.detection.sample - other.detection.sample) <= 12


def test_structure_takes_only_picks_near_its_centre(one_object):
    settings = DetectorSettings()
    large = replace(one_object[1], highlight_pings=(0, 200), atd_class="structure")
    far = Pick(1010, large.side, large.sample)
    assert not is_at_detection(large, 10, far, settings)
    assert is_at_detection(large, large.ping_index, far, settings)
    assert is_at_detection(replace(large, atd_class="clutter"), 10, far, settings)


def listed(capsys, *arguments):
    assert main(["detect", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])["files"][0]


def test_command_lists_picks_with_the_detected_contacts(file, capsys):
    plain = listed(capsys, file)
    both = listed(capsys, file, "--pick", "1030,port,10", "--pick", "1120,starboard,250")
    assert [contact["picked"] for contact in plain["contacts"]] == [False]
    detected, picked = both["contacts"]
    assert detected == plain["contacts"][0] | {"picked": True}
    assert both["contacts_above"] == plain["contacts_above"]
    assert (picked["ping"], picked["ping_number"], picked["channel"], picked["sample"]) == (30, 1030, "port", 10)
    assert (picked["atd_class"], picked["atd_confidence"], picked["length_m"]) == (PICKED, None, None)


def test_snippets_of_picks_can_be_sent_as_images(file, tmp_path, capsys):
    arguments = ["--pick", "1030,port,10", "--snippets", tmp_path / "s", "--plot", tmp_path / "p.png"]
    listed(capsys, file, *arguments)
    names = {p.name for p in (tmp_path / "s").iterdir() if "pick" in p.name}
    assert names == {"line7-002-pick.png", "line7-002-pick.txt"}
    side_car = read_side_car(tmp_path / "s" / "line7-002-pick.txt", "", "uuv-1")
    assert side_car.notes == ()
    assert (side_car.contact.ping_number, side_car.contact.atd_class) == (1030, PICKED)
    sent = read_snippet(tmp_path / "s" / "line7-002-pick.png", "0" * 64, "uuv-1", "refuse").snippet
    assert sent.contact.contact_id == side_car.contact.contact_id
    assert read_image(tmp_path / "s" / "line7-002-pick.png").shape == (100, 100)
    assert (tmp_path / "p.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--pick", "1"], "sonarpost: --pick: place: got '1', expected PING,SIDE,SAMPLE, for example 1120,port,300\n"),
        (["second.xtf", "--pick", "1000,port,5"], "sonarpost: --pick: survey files: got 2, expected one file\n"),
    ],
)
def test_invalid_pick_is_one_line_and_status_2(file, capsys, arguments, message):
    assert main(["detect", str(file), *arguments]) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", message)
