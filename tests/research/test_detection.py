from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from research.common.measurement import create_codecs
from research.detection import __main__ as command
from research.detection.__main__ import plot_all
from research.detection.codec_effect import codec_effects, confidence_with, contact_snippet
from research.detection.simulated import (
    EvaluatedContact,
    EvaluatedFile,
    Scale,
    object_at,
    operating_point,
    pd_at,
    reliability,
    roc,
)
from research.detection.tiles import TileScore, tile_auc, tile_scores
from sonarpost.codec.registry import default_registry
from sonarpost.detection.detector import detect
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.simulation.seabed.survey import TruthObject
from sonarpost.simulation.seabed.targets import ObjectKind
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import Side, Survey


def target(kind=ObjectKind.SPHERE, ping=100, sample=300, side=Side.PORT):
    mine = kind not in (ObjectKind.BOULDER, ObjectKind.DEBRIS, ObjectKind.RIDGE)
    return TruthObject(kind, mine, side, ping, sample, 0.0, 0.0, 10.0, 2.0, 1.0, 0.5, 0.0)


def judged(*contacts, truth):
    return EvaluatedFile(SeabedKind.SAND, Survey(Path("x"), "x", "x", ()), (), contacts, truth, 1.0)


def test_contact_is_assigned_to_the_nearest_object_of_its_side():
    scale = Scale(0.1, 0.03)
    truth = (target(), target(ping=110), target(side=Side.STARBOARD), target(ObjectKind.DEBRIS, ping=400))
    assert object_at(truth, Side.PORT, 101, 300.0, scale) == 0
    assert object_at(truth, Side.PORT, 109, 300.0, scale) == 1
    assert object_at(truth, Side.STARBOARD, 109, 320.0, scale) == 2
    assert object_at(truth, Side.PORT, 130, 300.0, scale) is None
    assert object_at(truth, Side.PORT, 101, 360.0, scale) is None
    assert object_at(truth, Side.PORT, 420, 300.0, scale) == 3  # half its length farther


def test_each_object_counts_once_and_contacts_without_object_are_false_alarms():
    mine, other_mine, stone = target(), target(ping=500), target(ObjectKind.BOULDER, ping=800)
    one = judged(
        EvaluatedContact(1.8, mine, True),
        EvaluatedContact(1.7, mine, False),
        EvaluatedContact(1.5, None, True),
        EvaluatedContact(1.2, stone, True),
        EvaluatedContact(0.6, other_mine, True),
        EvaluatedContact(0.4, None, True),
        truth=(mine, other_mine, stone),
    )
    at = operating_point([one], 1.0)
    assert (at.pd, at.false_alarms_per_file, at.others_per_file) == (0.5, 1.0, 1.0)
    curve = roc([one])
    assert [pd_at(curve, n) for n in (0.0, 1.0, 2.0)] == [0.5, 1.0, 1.0]
    assert pd_at(roc([one], "cylinder"), 9.0) == 0.0
    bins = reliability([one], bins=2)
    assert [(b.contacts, b.true_share) for b in bins] == [(2, 0.5), (3, pytest.approx(1 / 3))]


COLUMNS = "split,image,target_px,x0,y0,x1,y1"


def write_tile(folder, split, name, target):
    rng = np.random.default_rng(len(name))
    image = rng.rayleigh(60, (256, 256))
    if target:
        image[100:120, 100:120] *= 4
        image[100:120, 120:160] *= 0.05
    (folder / split / "images").mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.clip(image, 0, 255).astype(np.uint8)).save(folder / split / "images" / name)
    return f"{split},{name},256,256,{400 if target else 0},{'100,100,120,120' if target else ',,,'}"


def test_tiles_are_scored_and_their_auc_is_computed(tmp_path):
    rows = [write_tile(tmp_path, "test", f"{'t' if i < 2 else 'c'}{i}_{i}.png", i < 2) for i in range(4)]
    (tmp_path / "index.csv").write_text("\n".join(["split,image,w,h,target_px,x0,y0,x1,y1", *rows]))
    tiles = tile_scores(tmp_path)
    assert [t.is_target for t in tiles] == [True, True, False, False]
    assert tile_auc(tiles)[0] == 1.0
    with pytest.raises(SurveyFileError, match="targets and others"):
        tile_auc(tiles[:2])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "split,image\n",
        f"{COLUMNS}\ntest,../x.png,1,0,0,9,9\n",
        f"{COLUMNS}\nother,x.png,1,0,0,9,9\n",
        f"{COLUMNS}\ntest,x.png,many,0,0,9,9\n",
        f"{COLUMNS}\ntest,absent.png,1,0,0,9,9\n",
    ],
)
def test_invalid_index_is_a_survey_file_error(tmp_path, text):
    (tmp_path / "index.csv").write_text(text)
    with pytest.raises(SurveyFileError):
        tile_scores(tmp_path)


def test_codec_effect_has_one_result_a_budget_and_a_large_budget_keeps_the_confidence(make_survey):
    survey = make_survey({}, {"ping": 30, "side": Side.STARBOARD})
    found = next(d for d in detect(survey) if d.side is Side.PORT)
    one = contact_snippet(survey, found)
    assert one.confidence == pytest.approx(found.confidence, abs=0.1)
    ((codec,), _) = create_codecs(default_registry(), ["spiht"])
    small, large = codec_effects([one], codec, [16, 11_000])
    assert [(e.label, e.budget_bytes, e.coded, e.misses) for e in (small, large)] == [
        ("spiht", 16, 1, 0),
        ("spiht", 11_000, 1, 0),
    ]
    assert large.before == one.confidence
    assert large.after == pytest.approx(one.confidence, abs=0.05)
    assert (large.kept, small.kept) == (1.0, float(small.after >= 1.0))
    (missed,) = codec_effects([one], codec, [1])
    assert (missed.coded, missed.misses) == (0, 1)
    assert np.isnan(missed.after)


def test_image_without_the_object_has_no_confidence(make_survey):
    survey = make_survey({})
    (found,) = detect(survey)
    one = contact_snippet(survey, found)
    seabed = np.full_like(one.snippet.image, int(np.median(one.snippet.image)))
    assert confidence_with(one.survey, one.detection, one.snippet, seabed) < 0.5 < one.confidence


def test_plots_are_written_for_available_data(tmp_path):
    pytest.importorskip("matplotlib")
    one = judged(EvaluatedContact(1.8, target(), True), EvaluatedContact(0.4, None, True), truth=(target(),))
    tiles = [TileScore("test", f"{i}_a.png", i < 2, 1.0 - i / 10) for i in range(4)]
    plot_all(tmp_path / "out", [one], tiles, [])
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["reliability.png", "roc.png", "tiles.png"]


def bench(*arguments):
    return command.run(command.new_parser().parse_args([*map(str, arguments)]))


@pytest.mark.parametrize("options", [("--files", 0), ("--seed", -1), ("--pictures", 0), ("--budgets", "x")])
def test_error_names_the_option_out_of_range(options):
    with pytest.raises(ConfigError):
        bench(*options)


@pytest.mark.system
def test_last_line_is_the_json_object(capsys):
    assert bench("--files", 1, "--json") == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"pd", "false_alarms_per_file", "auc_sdvd", "seconds_per_file"} <= set(result)
    assert result["pd"] >= 0.9
    assert result["false_alarms_per_file"] <= 1.0
    assert result["auc_sdvd"] is None
    assert result["seabeds"]["rock"]["false_alarms_per_file"] <= 6.0
