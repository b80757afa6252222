"""`sonarpost detect` and the vehicle give the same contacts for the same files."""

import itertools
import json
from dataclasses import replace

import pytest
from builders.joined_surveys import FEW_CANDIDATES, Box, near, split, survey_of
from builders.xtf import write_xtf

from sonarpost.cli.main import main
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.messages import Contact
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.file_boundary import StoredEnd, pack, unpack
from sonarpost.services.atd_stub.input_folder import content_sha256
from sonarpost.services.atd_stub.survey_detection import detect_in_survey, snippets_of
from sonarpost.sonar.readers import read_survey


def command_contacts(paths, capsys, *options):
    """Return the contacts of `sonarpost detect --json` by identifier."""
    assert main(["detect", *map(str, paths), "--json", "--vehicle", "uuv-1", *options]) == 0
    files = json.loads(capsys.readouterr().out.splitlines()[-1])["files"]
    contacts = [contact for file in files for contact in file["contacts"]]
    found = {contact["contact_id"]: contact for contact in contacts}
    assert len(found) == len(contacts)
    return found


def vehicle_snippets(paths, **changes):
    """Return the snippets of the vehicle by identifier; its state is stored and restored after each file."""
    config = AtdStubConfig(join_timeout_s=60.0, **changes)
    sent, ends = [], {}
    for path in paths:
        result = detect_in_survey(path, content_sha256(path), "uuv-1", config, ends)
        sent += [*result.not_continued, *result.snippets]
        ends = {sonar: unpack(pack(StoredEnd(end, 100.0))).end for sonar, end in result.ends.items()}
    sent += [snippet for end in ends.values() for snippet in snippets_of(end.held)]
    found = {snippet.contact.contact_id: snippet for snippet in sent}
    assert len(found) == len(sent)
    return found


def check_agreement(paths, capsys, *options, **changes):
    """Check that identifiers, confidences, places and all other fields of the records agree; return the snippets."""
    command, vehicle = command_contacts(paths, capsys, *options), vehicle_snippets(paths, **changes)
    assert set(command) == set(vehicle) != set()
    for contact_id, listed in command.items():
        contact = vehicle[contact_id].contact.model_dump(mode="json")
        assert {name: listed[name] for name in Contact.model_fields if name in listed} == {
            name: value for name, value in contact.items() if name in listed
        }
        assert {"atd_confidence", "lat_deg", "lon_deg", "position_sigma_m"} <= listed.keys()
    return list(vehicle.values())


@pytest.fixture
def check_quickly(tmp_path, capsys):
    """`check_agreement` with fewer candidates."""
    path = tmp_path / "few.toml"
    path.write_text(f"min_matched_response = {FEW_CANDIDATES.min_matched_response}\n")
    return lambda paths: check_agreement(paths, capsys, "--settings", str(path), detector=FEW_CANDIDATES)


@pytest.mark.parametrize("boundary", [118, 122])
def test_object_at_the_boundary_of_two_files(boundary, tmp_path, capsys):
    survey = survey_of(300, Box(120), Box(40), Box(280))
    snippets = check_agreement(split(tmp_path, survey, (0, boundary), (boundary, 300)), capsys)
    assert [len(near(snippets, row)) for row in (40, 120, 280)] == [1, 1, 1]


def test_objects_at_the_boundaries_of_strips_and_files(tmp_path, check_quickly):
    rows = (899, 950, 1120)
    paths = split(tmp_path, survey_of(1300, *map(Box, rows)), (0, 1120), (1120, 1300))
    snippets = check_quickly(paths)
    assert [len(near(snippets, row)) for row in rows] == [1] * len(rows)


def test_simulated_line_with_settings(tmp_path, capsys):
    spec = SurveySpec(seed=4, pings=360, samples=400, targets=6, clutter=6, seabed=SeabedKind.MIXED)
    paths = split(tmp_path, simulate_survey(spec).survey, (0, 140), (140, 200), (200, 360))
    tuning = {"separation_along_m": 2.0, "shadow_lengths_m": [1.0, 4.0], "min_matched_response": 2.0}
    (tmp_path / "settings.toml").write_text(
        "separation_along_m = 2.0\nshadow_lengths_m = [1.0, 4.0]\nmin_matched_response = 2.0\n"
        "join_overlap_pings = 100\nconfidence_threshold = 0.2\n"
    )
    (tmp_path / "options.toml").write_text("[errors]\nposition_m = 1.5\n")
    options = ("--settings", str(tmp_path / "settings.toml"), "--options", str(tmp_path / "options.toml"))
    changes = {"detector": tuning, "join_overlap_pings": 100, "confidence_threshold": 0.2}
    snippets = check_agreement(paths, capsys, *options, errors={"position_m": 1.5}, **changes)
    assert all(1.5 <= snippet.contact.position_sigma_m < 3.5 for snippet in snippets)
    limited = check_agreement(
        paths, capsys, *options, "--max-contacts", "2", errors={"position_m": 1.5}, **changes, max_contacts=2
    )
    assert 3 <= len(limited) < len(snippets), "at most two contacts of each file"


def test_files_of_two_sonars_may_alternate(tmp_path, check_quickly):
    survey = survey_of(300, Box(148), Box(60), Box(240))
    paths = []
    for number, (first, end) in enumerate([(0, 149), (149, 300)]):
        for sonar in ("left", "right"):
            paths.append(tmp_path / f"{sonar}-{number}.xtf")
            write_xtf(replace(survey, pings=survey.pings[first:end], sonar_id=sonar), paths[-1])
    assert len(check_quickly(paths)) == 6


@pytest.mark.realdata
@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "boundaries"), [("scotsman-iver2", (150, 300)), ("000_1236", (400, 900)), ("000_1236", (1445,))]
)
def test_recordings_in_several_files(name, boundaries, data_dir, tmp_path, capsys):
    survey = read_survey(data_dir / "surveys" / f"{name}.xtf")
    edges = [0, *boundaries, len(survey.pings)]
    paths = split(tmp_path, survey, *itertools.pairwise(edges))
    check_agreement(paths, capsys, "--threshold", "0.3", confidence_threshold=0.3)


@pytest.mark.realdata
@pytest.mark.system
@pytest.mark.parametrize("name", ["scotsman-iver2", "000_1236"])
def test_object_of_a_recording_at_a_boundary(name, data_dir, tmp_path, capsys):
    path = data_dir / "surveys" / f"{name}.xtf"
    survey = read_survey(path)
    best = max(command_contacts([path], capsys).values(), key=lambda contact: contact["atd_confidence"])
    paths = split(tmp_path, survey, (0, best["ping"]), (best["ping"], len(survey.pings)))
    snippets = check_agreement(paths, capsys)
    same = [
        snippet
        for snippet in snippets
        if snippet.contact.channel == best["channel"]
        and abs(snippet.contact.slant_range_m - best["slant_range_m"]) < 3
        and abs(snippet.contact.time_utc_s - survey.pings[best["ping"]].time_utc_s) < 5
    ]
    assert len(same) == 1
