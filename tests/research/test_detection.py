from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from research.common.measurement import subjects
from research.detection import __main__ as command
from research.detection.codec_effect import confidence_with, effects, shot
from research.detection.plots import plot_all
from research.detection.simulated import JudgedContact, JudgedFile, operating, pd_at, reliability, roc
from research.detection.tiles import TileScore, tile_auc, tile_scores
from research.detection.truth import Scale, object_at
from sonarpost.codec.registry import default_registry
from sonarpost.detection.detector import detect
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.simulation.seabed.survey import TruthObject
from sonarpost.simulation.seabed.targets import ObjectKind
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import Side, Survey


def thing(kind=ObjectKind.SPHERE, ping=100, sample=300, side=Side.PORT):
    mine = kind not in (ObjectKind.BOULDER, ObjectKind.DEBRIS, ObjectKind.RIDGE)
    return TruthObject(kind, mine, side, ping, sample, 0.0, 0.0, 10.0, 2.0, 1.0, 0.5, 0.0)


def judged(*contacts, truth):
    return JudgedFile(SeabedKind.SAND, Survey(Path("x"), "x", "x", ()), (), contacts, truth, 1.0)


def test_a_contact_is_the_nearest_object_of_its_side_within_reach():
    scale = Scale(0.1, 0.03)
    truth = (thing(), thing(ping=110), thing(side=Side.STARBOARD), thing(ObjectKind.DEBRIS, ping=400))
    assert object_at(truth, Side.PORT, 101, 300.0, scale) == 0
    assert object_at(truth, Side.PORT, 109, 300.0, scale) == 1
    assert object_at(truth, Side.STARBOARD, 109, 320.0, scale) == 2
    assert object_at(truth, Side.PORT, 130, 300.0, scale) is None
    assert object_at(truth, Side.PORT, 101, 360.0, scale) is None
    assert object_at(truth, Side.PORT, 420, 300.0, scale) == 3  # half its length farther


def test_figures_count_each_object_once_and_only_empty_places_as_false_alarms():
    mine, other_mine, stone = thing(), thing(ping=500), thing(ObjectKind.BOULDER, ping=800)
    one = judged(
        JudgedContact(1.8, mine, True),
        JudgedContact(1.7, mine, False),
        JudgedContact(1.5, None, True),
        JudgedContact(1.2, stone, True),
        JudgedContact(0.6, other_mine, True),
        JudgedContact(0.4, None, True),
        truth=(mine, other_mine, stone),
    )
    at = operating([one], 1.0)
    assert (at.pd, at.false_alarms_per_file, at.others_per_file) == (0.5, 1.0, 1.0)
    curve = roc([one])
    assert [pd_at(curve, n) for n in (0.0, 1.0, 2.0)] == [0.5, 1.0, 1.0]
    assert pd_at(roc([one], "cylinder"), 9.0) == 0.0
    bins = reliability([one], bins=2)
    assert [(b.contacts, b.true_share) for b in bins] == [(2, 0.5), (3, pytest.approx(2 / 3))]


def write_tile(folder, split, name, target):
    rng = np.random.default_rng(len(name))
    picture = rng.rayleigh(60, (256, 256))
    if target:
        picture[100:120, 100:120] *= 4
        picture[100:120, 120:160] *= 0.05
    (folder / split / "images").mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.clip(picture, 0, 255).astype(np.uint8)).save(folder / split / "images" / name)
    return f"{split},{name},256,256,{400 if target else 0},,,,"


def test_tiles_are_scored_and_their_curve_measured(tmp_path):
    rows = [write_tile(tmp_path, "test", f"{'t' if i < 2 else 'c'}{i}_{i}.png", i < 2) for i in range(4)]
    (tmp_path / "index.csv").write_text("\n".join(["split,image,w,h,target_px,x0,y0,x1,y1", *rows]))
    tiles = tile_scores(tmp_path)
    assert [t.is_target for t in tiles] == [True, True, False, False]
    assert tile_auc(tiles)[0] == 1.0
    with pytest.raises(SurveyFileError, match="targets and others"):
        tile_auc(tiles[:2])


@pytest.mark.parametrize(
    "text",
    ["", "split,image\n", "split,image,target_px\ntest,../x.png,1\n", "split,image,target_px\nother,x.png,1\n",
     "split,image,target_px\ntest,x.png,many\n", "split,image,target_px\ntest,absent.png,1\n"],
)  # fmt: skip
def test_a_bad_index_is_one_documented_error(tmp_path, text):
    (tmp_path / "index.csv").write_text(text)
    with pytest.raises(SurveyFileError):
        tile_scores(tmp_path)


def test_a_codec_is_judged_at_each_budget_in_the_survey_and_a_large_one_keeps_the_confidence(make_survey):
    survey = make_survey({}, {"ping": 30, "side": Side.STARBOARD})
    found = next(d for d in detect(survey) if d.side is Side.PORT)
    one = shot(survey, found)
    assert one.confidence == pytest.approx(found.confidence, abs=0.1)
    ((subject,), _) = subjects(default_registry(), ["spiht"])
    small, large = effects([one], subject, [16, 11_000])
    assert [(e.label, e.budget_bytes, e.pictures, e.misses) for e in (small, large)] == [
        ("spiht", 16, 1, 0),
        ("spiht", 11_000, 1, 0),
    ]
    assert large.before == one.confidence
    assert large.after == pytest.approx(one.confidence, abs=0.05)
    assert (large.kept, small.kept) == (1.0, float(small.after >= 1.0))
    (absent,) = effects([one], subject, [1])
    assert (absent.pictures, absent.misses) == (0, 1)
    assert np.isnan(absent.after)


def test_a_picture_without_the_object_has_no_confidence_left(make_survey):
    survey = make_survey({})
    (found,) = detect(survey)
    one = shot(survey, found)
    seabed = np.full_like(one.cut.image, int(np.median(one.cut.image)))
    assert confidence_with(one.survey, one.found, one.cut, seabed) < 0.5 < one.confidence


def test_plots_are_written_for_what_there_is(tmp_path):
    pytest.importorskip("matplotlib")
    one = judged(JudgedContact(1.8, thing(), True), JudgedContact(0.4, None, True), truth=(thing(),))
    tiles = [TileScore("test", f"{i}_a.png", i < 2, 1.0 - i / 10) for i in range(4)]
    plot_all(tmp_path / "out", [one], tiles, [])
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["reliability.png", "roc.png", "tiles.png"]


def bench(*arguments):
    return command.run(command.new_parser().parse_args([*map(str, arguments)]))


@pytest.mark.parametrize("options", [("--files", 0), ("--seed", -1), ("--pictures", 0), ("--budgets", "x")])
def test_an_option_out_of_range_is_named(options):
    with pytest.raises(ConfigError):
        bench(*options)


@pytest.mark.long
def test_the_bench_ends_with_its_figures(capsys):
    assert bench("--files", 1, "--json") == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"pd", "false_alarms_per_file", "auc_sdvd", "seconds_per_file"} <= set(result)
    assert result["pd"] >= 0.9
    assert result["false_alarms_per_file"] <= 1.0
    assert result["auc_sdvd"] is None
    assert result["seabeds"]["rock"]["false_alarms_per_file"] <= 6.0
