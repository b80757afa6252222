"""Masking of pings that were recorded while the vehicle's own modem transmitted."""

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.xtf import write_xtf
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.cli.detection.options import read_transmissions
from sonarpost.cli.main import main
from sonarpost.detection.detector import detect
from sonarpost.detection.stream import FileOrigin, StreamDetector
from sonarpost.detection.transmissions import MaskedSource, TransmitIntervals
from sonarpost.errors import ConfigError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource, load_survey
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

pytestmark = pytest.mark.usefixtures("few_candidates")

START_S = 1.0e9
PINGS_PER_S = 10.0
RANGE_M = 15.0
LISTENED_S = 0.02
BURSTS = ((30, 38), (80, 88))
"""First and one-past-last ping of each burst."""


def ping_at(time_s, range_m=RANGE_M):
    samples = np.zeros(4, dtype=np.uint8)
    return Ping(7, time_s, (ChannelPing(Side.PORT, samples, range_m),), lat_deg=60.0, altitude_m=3.0)


def with_bursts(survey, seed=3):
    """Return the survey with bursts of a modem: loud noise, after which the saturated receiver records little."""
    rng = np.random.default_rng(seed)
    pings = list(survey.pings)
    for first, end in BURSTS:
        sample = int(rng.integers(150, 350))
        for row in range(first, end):
            channels = []
            for channel in pings[row].channels:
                samples = channel.samples.astype(np.float64)
                samples[sample : sample + 12] *= 5.0
                samples[sample + 12 : sample + 45] *= 0.05
                channels.append(replace(channel, samples=np.clip(samples, 0, 65535).astype(np.uint16)))
            pings[row] = replace(pings[row], channels=tuple(channels))
    return replace(survey, pings=tuple(pings))


def transmissions(bursts=BURSTS):
    """Return start and end of each burst."""
    return [(START_S + first / PINGS_PER_S, START_S + (end - 1) / PINGS_PER_S) for first, end in bursts]


def masked(survey, intervals):
    source = InMemorySource(survey, SurveyOptions(heading_source="sensor"))
    return load_survey(MaskedSource(source, intervals))


def test_margins_and_listening_time_belong_to_a_transmission():
    intervals = TransmitIntervals.of([(100.0, 105.0)], 0.2, 0.5)
    inside = {99.77: False, 99.79: True, 100.0: True, 105.0: True, 105.49: True, 105.5: True, 105.51: False}
    assert {time_s: intervals.contains(ping_at(time_s)) for time_s in inside} == inside


def test_a_transmission_during_the_reception_of_the_echo_and_each_clock_masks_the_ping():
    intervals = TransmitIntervals.of([(100.0, 101.0)], 0.0, 0.0)
    assert intervals.contains(ping_at(99.9, 75.0))
    assert not intervals.contains(ping_at(99.89, 75.0))
    # A step of the clock masks what each clock has stamped.
    intervals = TransmitIntervals.of([(1000.0, 1003.0), (400.0, 403.0)])
    assert [intervals.contains(ping_at(time_s)) for time_s in (1001.0, 401.0, 700.0)] == [True, True, False]


def test_unsorted_and_overlapping_intervals_are_joined():
    intervals = TransmitIntervals.of([(30.0, 31.0), (10.0, 20.0), (12.0, 13.0), (19.0, 22.0), (31.5, 32.0)], 0.5, 0.5)
    assert intervals.starts_utc_s == (9.5, 29.5)
    assert intervals.ends_utc_s == (22.5, 32.5)


@given(
    st.lists(st.tuples(st.floats(0, 50), st.floats(0, 9)).map(lambda pair: (pair[0], sum(pair))), max_size=12),
    st.floats(0, 60),
    st.floats(0, 2),
    st.floats(0, 2),
)
def test_a_ping_is_in_the_union_of_all_intervals(pairs, time_s, before_s, after_s):
    expected = any(start_s - before_s <= time_s + LISTENED_S and time_s <= end_s + after_s for start_s, end_s in pairs)
    assert TransmitIntervals.of(pairs, before_s, after_s).contains(ping_at(time_s)) is expected


def test_invalid_intervals_and_margins_are_one_error():
    for pair in ((2.0, 1.0), (math.nan, 1.0), (1.0, math.nan), (-math.inf, 0.0), (0.0, math.inf)):
        with pytest.raises(ValueError, match="transmission: got"):
            TransmitIntervals.of([(0.0, 1.0), pair])
    for margins in ((-0.1, 0.0), (0.0, math.nan), (math.inf, 0.0)):
        with pytest.raises(ValueError, match="margins: got"):
            TransmitIntervals.of([], *margins)


def test_a_masked_ping_keeps_its_navigation():
    quiet, loud = ping_at(90.0), ping_at(101.0)
    survey = Survey(Path("a.xtf"), "x", "a", (quiet, loud))
    first, second = masked(survey, TransmitIntervals.of([(100.0, 105.0)]))
    assert first is quiet
    assert second == replace(loud, channels=())


def test_bursts_are_contacts_without_masking_and_none_with_it(make_survey):
    survey = with_bursts(make_survey())
    found = detect(survey)
    for first, end in BURSTS:
        assert [d for d in found if first <= d.ping_index < end], "the bursts must resemble objects"
    assert detect(masked(survey, TransmitIntervals.of(transmissions()))) == ()


def test_an_object_beside_the_bursts_is_found_at_the_same_place(make_survey):
    quiet = make_survey({"ping": 145, "sample": 260})
    (expected,) = detect(quiet)
    (found,) = detect(masked(with_bursts(quiet), TransmitIntervals.of(transmissions())))
    assert found.side is expected.side
    assert found.ping_index == pytest.approx(expected.ping_index, abs=1)
    assert found.sample == pytest.approx(expected.sample, abs=2)
    assert found.length_m == pytest.approx(expected.length_m, abs=0.15)
    assert found.shadow_m == pytest.approx(expected.shadow_m, abs=0.2)
    assert found.confidence == pytest.approx(expected.confidence, abs=0.15)


@pytest.mark.parametrize("length", [1, 12, 60])
def test_masked_pings_have_no_edges(length, make_survey):
    survey = make_survey(seed=length % 4)
    bursts = [(first, first + length) for first in (20, 100)]
    assert detect(masked(survey, TransmitIntervals.of(transmissions(bursts)))) == ()


@pytest.mark.parametrize("altitude", [True, False])
def test_no_contact_has_its_centre_in_a_masked_ping(altitude, make_survey):
    survey = make_survey({"ping": 100}, sides=(Side.PORT,), altitude=altitude)
    intervals = TransmitIntervals.of([(START_S + 9.9, START_S + 10.1)])
    hidden = {row for row, ping in enumerate(survey.pings) if intervals.contains(ping)}
    assert {d.ping_index for d in detect(masked(survey, intervals))}.isdisjoint(hidden)
    assert detect(masked(survey, TransmitIntervals.of([(START_S, START_S + 60.0)]))) == (), "all pings are masked"


def add(detector, survey, intervals):
    source = MaskedSource(InMemorySource(survey, SurveyOptions()), intervals)
    return detector.add_file(source, FileOrigin.of(source, survey.path.stem))


def halves(survey, boundary):
    edges = itertools.pairwise((0, boundary, len(survey.pings)))
    return [replace(survey, path=Path(f"{n}.xtf"), pings=survey.pings[a:b]) for n, (a, b) in enumerate(edges)]


def test_masked_pings_are_counted(make_survey):
    intervals = TransmitIntervals.of(transmissions([(0, 150)]), 0.0, 0.0)
    source = MaskedSource(InMemorySource(make_survey(), SurveyOptions()), intervals)
    assert len(list(source.pings())) == 200
    assert (source.masked_count, source.masked_share) == (150, 0.75)


@pytest.mark.parametrize("burst", [(85, 100), (90, 110)])
def test_files_are_joined_at_a_boundary_in_masked_pings(burst, make_survey):
    survey = make_survey({"ping": 70}, {"ping": 140})
    detector = StreamDetector(lambda survey, detection, origin: survey.pings[detection.ping_index].number - 1000)
    intervals = TransmitIntervals.of(transmissions([burst]))
    results = [add(detector, half, intervals) for half in halves(survey, 100)]
    assert results[1].joined
    contacts = [c.content for r in results for c in (*r.released, *r.contacts)] + [c.content for c in detector.finish()]
    assert sorted(contacts) == [pytest.approx(70, abs=3), pytest.approx(140, abs=3)]


def test_masked_pings_do_not_join_recordings_with_other_channels(make_survey):
    first, second = halves(make_survey(), 100)
    shorter = [
        replace(p, channels=tuple(replace(c, samples=c.samples[:300]) for c in p.channels)) for p in second.pings
    ]
    detector = StreamDetector(lambda survey, detection, origin: None)
    intervals = TransmitIntervals.of(transmissions([(90, 110)]))
    add(detector, first, intervals)
    assert not add(detector, replace(second, pings=tuple(shorter)), intervals).joined


@pytest.fixture(scope="module")
def noisy_file(make_survey, tmp_path_factory):
    path = tmp_path_factory.mktemp("noisy") / "line.xtf"
    write_xtf(with_bursts(make_survey({"ping": 145}, sides=(Side.PORT,))), path)
    return path


def written(path, name):
    """Write the transmissions as JSON or CSV."""
    pairs = transmissions()
    rows = [{"start_utc_s": start_s, "end_utc_s": end_s} for start_s, end_s in pairs]
    lines = ["start_utc_s,end_utc_s", *(f"{start_s},{end_s}" for start_s, end_s in pairs)]
    text = "\n".join(lines) if name.endswith(".csv") else json.dumps({"transmissions": rows, "platform_id": "uuv-1"})
    (path / name).write_text(text)
    return path / name


@pytest.mark.parametrize("name", ["times.json", "times.csv"])
def test_the_command_masks_the_transmissions_of_a_file(name, noisy_file, tmp_path, capsys):
    assert main(["detect", str(noisy_file), "--json", "--transmissions", str(written(tmp_path, name))]) == 0
    (file,) = json.loads(capsys.readouterr().out)["files"]
    assert [contact["ping"] for contact in file["contacts"]] == [pytest.approx(145, abs=3)]
    assert 16 < file["masked_pings"] <= 36


def test_the_command_prints_the_masked_pings_and_refuses_invalid_margins(noisy_file, tmp_path, capsys):
    options = ["--transmissions", str(written(tmp_path, "times.json")), "--transmission-margins", "20", "20"]
    assert main(["detect", str(noisy_file), *options]) == 0
    assert "  note: 200 of 200 pings masked: the modem transmitted" in capsys.readouterr().out.splitlines()
    assert main(["detect", str(noisy_file), "--transmissions", str(tmp_path / "none.json")]) == 2
    assert main(["detect", str(noisy_file), "--transmission-margins", "-1", "0"]) == 2
    assert "detect: --transmission-margins: got" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "text", "field"),
    [
        ("a.json", "{", "transmissions"),
        ("a.json", "[]", "transmissions"),
        ("a.json", "{}", "transmissions"),
        ("a.json", '{"transmissions": 5}', "transmissions"),
        ("a.json", '{"transmissions": [1]}', "transmissions.0"),
        ("a.json", '{"transmissions": [{"start_utc_s": 1}]}', "transmissions.0.end_utc_s"),
        ("a.json", '{"transmissions": [{"start_utc_s": 1, "end_utc_s": 302}]}', "transmissions.0.end_utc_s"),
        ("a.json", '{"transmissions": [{"start_utc_s": NaN, "end_utc_s": 2}]}', "transmissions.0.start_utc_s"),
        ("a.json", "[" * 100_000, "transmissions"),
        ("a.csv", "", "transmissions"),
        ("a.csv", "start,end\n1,2\n", "transmissions"),
        ("a.csv", "start_utc_s,end_utc_s\n1\n", "transmissions"),
        ("a.csv", "start_utc_s,end_utc_s\n1,x\n", "transmissions"),
        ("a.csv", "start_utc_s,end_utc_s\n2,1\n", "transmissions.0.end_utc_s"),
        ("a.csv", "\udcff", "transmissions"),
    ],
)
def test_an_invalid_file_is_one_error(name, text, field, tmp_path):
    (tmp_path / name).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ConfigError) as caught:
        read_transmissions(tmp_path / name)
    assert caught.value.field == field
