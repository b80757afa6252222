"""Recordings with conditions met in the field: each has one bright target to starboard of a track to the east."""

import json
from dataclasses import dataclass, field
from datetime import UTC, datetime

import pytest

from sonarpost.cli.main import main
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.survey import Side

pytestmark = pytest.mark.realdata

BOTH = (Side.PORT, Side.STARBOARD)
SVLOG_UTC = ("2026-07-23T11:45:02.9", "2026-07-23T11:45:06.6")


@dataclass(frozen=True)
class Case:
    """The right outcome of a file.

    Attributes:
        pings: Number of pings.
        note: Text that one of the notes contains; empty if the file needs none.
        sides: Sides of the recording.
        frequency_hz: Frequency of all channels, if checked.
        contact: Position of the only contact, if checked.
        times: First and last time that pings may have.
        options: Options of the survey, and for `detect`.
    """

    pings: int
    note: str = ""
    sides: tuple[Side, ...] = BOTH
    frequency_hz: float | None = None
    contact: str = ""
    times: tuple[str, str] | None = None
    options: dict[str, object] = field(default_factory=dict)


SVLOG_CONTACT, XTF_CONTACT = "svlog-reference.svlog", "xtf-reference.xtf"
CASES = {
    "svlog-reference.svlog": Case(70, contact=SVLOG_CONTACT, times=SVLOG_UTC),
    "svlog-starboard-alone.svlog": Case(70, "only", (Side.STARBOARD,), contact=SVLOG_CONTACT, times=SVLOG_UTC),
    "svlog-batches.svlog": Case(70, contact=SVLOG_CONTACT, times=SVLOG_UTC),
    "svlog-sonar-older-than-computer.svlog": Case(
        70, contact=SVLOG_CONTACT, times=("2026-07-23T11:45:00", "2026-07-23T11:45:04")
    ),
    "svlog-nmea-no-checksum.svlog": Case(70, "without checksum"),
    "sl3-frame-version-10.sl3": Case(120),
    "sl3-frame-version-13.sl3": Case(120),
    "sl2-reference.sl2": Case(120),
    "sl2-dropped-byte.sl2": Case(119, "at byte"),
    "sl2-cut-last-frame.sl2": Case(119, "the file ends inside its last frame"),
    "xtf-reference.xtf": Case(100, contact=XTF_CONTACT),
    "xtf-zero-tail.xtf": Case(100, "4096 zero bytes", contact=XTF_CONTACT),
    "xtf-layback-sensor-is-ship.xtf": Case(100, "layback of 45 m is not applied"),
    "xtf-sides-in-separate-packets.xtf": Case(80),
    "xtf-dual-frequency-separate-packets.xtf": Case(60, "2 channel sets", frequency_hz=400e3),
    "xtf-dual-frequency-one-packet.xtf": Case(60, "2 channel sets", frequency_hz=400e3),
    "xtf-packets-without-channels.xtf": Case(80, "without channels"),
    "xtf-across-180.xtf": Case(100),
    "xtf-ship-gyro-only.xtf": Case(100, "ship's gyro", contact=XTF_CONTACT),
    "xtf-state-plane-feet.xtf": Case(100, options={"projected_crs": "EPSG:2263"}),
    "jsf-reference-400khz.jsf": Case(70, frequency_hz=410e3),
    "jsf-850khz.jsf": Case(70, frequency_hz=850e3),
    "jsf-zero-tail.jsf": Case(70, "4096 zero bytes"),
}


@pytest.fixture
def surveys(data_dir):
    folder = data_dir.parent / "cases" / "surveys"
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}")
    return folder


def contacts_of(path, capsys, *arguments):
    assert main(["detect", str(path), "--json", *arguments]) == 0
    (listed,) = json.loads(capsys.readouterr().out)["files"]
    return listed["contacts"]


def test_every_recording_has_its_outcome_here(surveys):
    assert {path.name for path in surveys.iterdir()} == set(CASES)


@pytest.mark.parametrize("name", CASES)
def test_pings_sides_times_and_notes(name, surveys):
    case = CASES[name]
    with open_survey(surveys / name, SurveyOptions(**case.options)) as source:
        pings = list(source.pings())
        notes = "\n".join(source.info.warnings)
        assert (len(pings), source.info.ping_count, source.info.sides) == (case.pings, case.pings, case.sides)
    assert case.note in notes
    for ping in pings:
        assert tuple(channel.side for channel in ping.channels) == case.sides
        assert (ping.lat_deg is None) is (ping.heading_deg is None) is False
        if case.frequency_hz is not None:
            assert {channel.frequency_hz for channel in ping.channels} == {case.frequency_hz}
        if case.times is not None:
            first, last = (datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp() for text in case.times)
            assert first <= ping.time_utc_s <= last
    ranges = [ping.max_slant_range_m() for ping in pings]
    assert max(ranges) - min(ranges) < 0.1, "one range: images are not mixed"


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.contact])
def test_contact_is_where_it_is_in_the_reference(name, surveys, capsys):
    (found,) = contacts_of(surveys / name, capsys)
    (expected,) = contacts_of(surveys / CASES[name].contact, capsys)
    assert found["channel"] == "starboard"
    off_m = offset_between_m(*(Position(each["lat_deg"], each["lon_deg"]) for each in (expected, found)))
    assert max(map(abs, off_m)) < 0.5, off_m
    assert found["position_sigma_m"] >= expected["position_sigma_m"] - 0.01


def test_frame_versions_have_the_same_samples(surveys):
    for name in "sl3-frame-version-10.sl3", "sl3-frame-version-13.sl3":
        with open_survey(surveys / name) as source:
            ping = next(ping for ping in source.pings() if ping.number == 62)
            assert int(ping.channel(Side.STARBOARD).samples.argmax()) == 120, name


@pytest.mark.parametrize("name", ["xtf-dual-frequency-separate-packets.xtf", "xtf-dual-frequency-one-packet.xtf"])
def test_the_other_frequency_can_be_chosen(name, surveys):
    with open_survey(surveys / name, SurveyOptions(frequency_hz=100e3)) as source:
        assert {c.frequency_hz for ping in source.pings() for c in ping.channels} == {100e3}
        assert [each.frequency_hz for each in source.info.channel_sets] == [400e3, 100e3]


def test_layback_is_applied_along_the_track_on_demand(surveys, capsys):
    path = surveys / "xtf-layback-sensor-is-ship.xtf"
    (plain,) = contacts_of(path, capsys)
    assert "recorded layback" in plain["position_note"]
    with open_survey(path) as source, open_survey(path, SurveyOptions(recorded_layback="apply")) as applied:
        for ship, towed in zip(source.pings(), applied.pings(), strict=True):
            north_m, east_m = offset_between_m(
                Position(ship.lat_deg, ship.lon_deg), Position(towed.lat_deg, towed.lon_deg)
            )
            assert (round(north_m), round(east_m)) == (0, -45)
            assert towed.position_note is None


def test_track_across_180_degrees_is_short(surveys, capsys, tmp_path):
    path = surveys / "xtf-across-180.xtf"
    assert main(["survey", "info", str(path), "--json"]) == 0
    west, east = json.loads(capsys.readouterr().out)["lon_deg"]
    assert west > 179.9 > -179.9 > east
