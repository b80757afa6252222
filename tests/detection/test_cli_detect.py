"""`sonarpost detect`."""

import json
import re
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from builders.xtf import write_xtf
from PIL import Image

from sonarpost.cli.detection import command
from sonarpost.cli.main import parser
from sonarpost.detection import candidates
from sonarpost.detection.detector import CLUTTER, MINE_LIKE, STRUCTURE
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.messages import AtdClass, Contact
from sonarpost.sonar.side_car import read_side_car
from sonarpost.sonar.survey import Side

pytestmark = pytest.mark.usefixtures("few_candidates")


def run(*arguments):
    parsed = parser("detect").parse_args(["detect", *map(str, arguments)])
    return parsed.run(parsed)


@pytest.fixture(scope="module")
def file(make_survey, tmp_path_factory):
    path = tmp_path_factory.mktemp("survey") / "line7.xtf"
    write_xtf(make_survey({"side": Side.STARBOARD, "ping": 120}), path)
    return path


def listed(capsys, *arguments):
    """Return what the command prints of each file as JSON."""
    assert run(*arguments, "--json") == 0
    return json.loads(capsys.readouterr().out.splitlines()[-1])["files"]


def test_table_lists_each_contact(file, capsys):
    assert run(file) == 0
    title, seabed, columns, line = capsys.readouterr().out.splitlines()
    assert title == f"{file}: 200 pings, 1 contacts"
    assert re.fullmatch(
        r"  seabed: \d+ clutter echoes per 1000 m², ripples 0\.\d, expected Pd [01]\.\d\d at threshold 0\.3", seabed
    )
    assert len(columns.split()) == len(line.split())
    assert {"lat_deg", "lon_deg", "sigma_m"} < set(columns.split())
    assert line.split()[2] == "mine_like"
    assert line.split()[5] == "starboard"


def test_json_states_contacts_and_seabed_and_snippets_are_written(file, tmp_path, capsys):
    (found,) = listed(capsys, file, "--vehicle", "uuv-7", "--threshold", "0.5", "--snippets", tmp_path)
    assert (found["file"], found["pings"]) == (str(file), 200)
    assert found["seconds"] > 0
    (contact,) = found["contacts"]
    assert contact["vehicle_id"] == "uuv-7"
    assert contact["channel"] == "starboard"
    assert contact["ping"] == pytest.approx(120, abs=3)
    assert contact["ping_number"] == 1000 + contact["ping"]
    assert contact["time_utc"].startswith("2001-09-09T01:46:5")
    assert 1.0 <= contact["atd_confidence"] <= 2.0
    assert contact["lat_deg"] == pytest.approx(60.0, abs=0.01)
    assert contact["position_sigma_m"] == pytest.approx(5.0, abs=0.2)
    missing = set(Contact.model_fields) - set(contact)
    assert missing <= {"type", "v", "schema_version", "time_utc_s"}, missing
    seabed = found["seabed"]
    assert seabed["threshold"] == 0.5
    assert 0.0 <= seabed["expected_pd"] <= 1.0
    assert 0.0 <= seabed["ripple_strength"] <= 1.0
    spans = [(s["first_ping"], s["end_ping"], s["channel"]) for s in seabed["strips"]]
    assert spans == [(0, 200, "port"), (0, 200, "starboard")]
    assert sum(s["area_m2"] for s in seabed["strips"]) == pytest.approx(seabed["area_m2"], abs=0.01)
    echoes = sum(s["area_m2"] * s["clutter_per_1000_m2"] for s in seabed["strips"])
    assert echoes / seabed["area_m2"] == pytest.approx(seabed["clutter_per_1000_m2"], abs=0.01)
    # Snippets at both scales with side-cars.
    names = ["line7-001-ground.png", "line7-001-ground.txt", "line7-001.png", "line7-001.txt"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    native, ground = (read_side_car(tmp_path / name, "", "uuv").contact for name in (names[3], names[1]))
    for name, value in native.model_dump(exclude={"time_utc_s", "vehicle_id"}).items():
        assert value == contact[name], name
    assert native.time_utc_s == pytest.approx(1_000_000_000, abs=20)
    assert (ground.pixel_along_m, ground.pixel_across_m) == (0.1, 0.1)
    assert ground.contact_id != native.contact_id
    assert (ground.lat_deg, ground.lon_deg) == (native.lat_deg, native.lon_deg)
    with Image.open(tmp_path / names[0]) as image:
        assert image.size == (100, 100)


def test_seabed_of_a_short_file_is_unknown(make_survey, tmp_path, capsys):
    survey = make_survey()
    path = tmp_path / "short.xtf"
    write_xtf(replace(survey, pings=survey.pings[:30]), path)
    assert run(path) == 0
    assert "  seabed: too little of it is known to state its difficulty" in capsys.readouterr().out.splitlines()
    seabed = listed(capsys, path)[0]["seabed"]
    assert seabed["expected_pd"] is None
    assert [s["expected_pd"] for s in seabed["strips"]] == [None, None]


def test_consecutive_files_are_one_line(make_survey, tmp_path, capsys):
    survey = make_survey({"ping": 99, "sample": 300}, {"ping": 40, "sample": 350}, {"ping": 165, "sample": 400})
    paths = [tmp_path / "a.xtf", tmp_path / "b.xtf"]
    for path, pings in zip(paths, (survey.pings[:100], survey.pings[100:]), strict=True):
        write_xtf(replace(survey, pings=pings), path)
    files = listed(capsys, *paths, "--plot", tmp_path / "out.png")
    found = [(number, c["ping"], c["sample"]) for number, f in enumerate(files) for c in f["contacts"]]
    at_boundary = [100 * number + ping for number, ping, sample in found if abs(sample - 300) < 10]
    assert at_boundary == [pytest.approx(99, abs=3)]
    assert {p.name for p in tmp_path.glob("*.png")} == {"out-a.png", "out-b.png"}
    assert [f["contacts_above"]["0.3"] for f in files] == [len(f["contacts"]) for f in files] == [2, 1]


def test_plot_marks_contact_on_its_side_and_has_scales(file, tmp_path, capsys):
    # The same file twice has one plot.
    first, second = listed(capsys, file, file, "--plot", tmp_path / "absent" / "out.png")
    assert first["contacts"] == second["contacts"]
    assert [p.name for p in (tmp_path / "absent").iterdir()] == ["out-line7.png"]
    with Image.open(tmp_path / "absent" / "out-line7.png") as image:
        pixels = np.asarray(image).astype(int)
    assert pixels.shape == (22 + 200 + 34, 150 + 2 * 512 + 30, 3)
    rows, columns = np.nonzero((pixels[..., 0] == 255) & (pixels[..., 1] == 80) & (pixels[..., 2] == 60))
    assert columns.min() > 150 + 512 + 230
    assert abs(rows.min() - 22 - 110) < 5
    ink = pixels.max(axis=2) == 20
    assert ink[:, 144:150].any(), "times and ping numbers"
    assert ink[-34:, 150:-30].any(), "ranges"


def test_thresholds_and_number_of_contacts(tmp_path, capsys, monkeypatch):
    """A file with no contact above the threshold says what lower thresholds give."""
    monkeypatch.setattr(candidates, "_MAX_PER_1000_PINGS", 60)
    file = tmp_path / "rock.xtf"
    spec = SurveySpec(seed=2, seabed=SeabedKind.ROCK, pings=150, samples=256, targets=2, clutter=4)
    write_xtf(simulate_survey(spec).survey, file)
    (found,) = listed(capsys, file, "--threshold", "2")
    assert found["contacts"] == []
    counts = found["contacts_above"]
    assert list(counts) == ["2.0", "1.0", "0.5", "0.3", "0.1"]
    assert counts["2.0"] == 0
    assert counts["0.1"] > counts["0.3"] > counts["1.0"] >= 1
    assert run(file, "--threshold", "2") == 0
    title, _, message = capsys.readouterr().out.splitlines()
    assert title == f"{file}: 150 pings, 0 contacts"
    lower = ", ".join(f"{counts[c]} above {c}" for c in ("1.0", "0.5", "0.3", "0.1"))
    assert message == f"0 contacts above 2.0; {lower}; see --threshold"
    (at,) = listed(capsys, file, "--threshold", "0.3")
    assert len(at["contacts"]) == counts["0.3"]
    assert at["contacts_above"] == {name: counts[name] for name in ("0.3", "0.1")}
    (limited,) = listed(capsys, file, "--threshold", "0.3", "--max-contacts", "1")
    assert limited["contacts"] == at["contacts"][:1]


@pytest.mark.system
@pytest.mark.realdata
@pytest.mark.parametrize("name", ["scotsman-iver2", "000_1236"])
def test_counts_of_recordings_are_those_of_the_thresholds(data_dir, name, capsys):
    path = data_dir / "surveys" / f"{name}.xtf"
    for confidence, count in listed(capsys, path, "--threshold", "2")[0]["contacts_above"].items():
        assert len(listed(capsys, path, "--threshold", confidence)[0]["contacts"]) == count


def test_settings_are_read_from_a_file(file, tmp_path, capsys):
    settings = tmp_path / "settings.toml"
    settings.write_text("confidence_threshold = 2.0\nmax_contacts = 4\n")
    assert listed(capsys, file, "--settings", settings)[0]["contacts"] == []
    (found,) = listed(capsys, file, "--settings", settings, "--threshold", "1")
    assert len(found["contacts"]) == 1, "an option overrides the file"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("ring_m = 0", "ring_m: got 0, expected greater than 0"),
        ("rings = 1", "rings: got 1, expected a known name"),
        ("ring_m = true", "ring_m: got True, expected a valid number"),
        ("ring_m = [", "TOML"),
        ("a = " + "[" * 5000, "TOML"),
        ("#" * 70_000, "file size"),
    ],
)
def test_error_names_invalid_setting(file, tmp_path, text, error):
    (tmp_path / "settings.toml").write_text(text)
    with pytest.raises(ConfigError, match=rf"settings\.toml: .*{error}"):
        run(file, "--settings", tmp_path / "settings.toml")


def test_invalid_options_file_and_output_are_reported_before_the_work(file, tmp_path, monkeypatch):
    (tmp_path / "bad.xtf").write_bytes(b"not a survey")
    with pytest.raises(SurveyFileError):
        run(tmp_path / "bad.xtf")
    monkeypatch.setattr(command._Detection, "run", lambda *_: pytest.fail("the work has begun"))
    for options in (("--threshold", "3"), ("--threshold", "nan"), ("--max-contacts", "0")):
        with pytest.raises(ConfigError, match=r"threshold|max_contacts"):
            run(file, *options)
    with pytest.raises(ConfigError, match="--vehicle: got 'no vehicle'"):
        run(file, "--vehicle", "no vehicle")
    for option in ("--plot", "--snippets"):
        with pytest.raises(ConfigError, match=r"output folder: got .*bad\.xtf"):
            run(file, option, tmp_path / "bad.xtf" / "out.png")


def test_classes_of_the_detector_are_those_of_the_contact_record():
    assert set(get_args(AtdClass)) == {MINE_LIKE, CLUTTER, STRUCTURE}
