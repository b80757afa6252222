"""`python -m research.detection`: assignment of contacts, figures, tiles, effect of codecs."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from research.codecs.baselines import comparison_registry
from research.common.measurement import create_codecs
from research.detection import __main__ as command
from research.detection import simulated
from research.detection.codec_effect import codec_effects, confidence_with, contact_snippet
from research.detection.simulated import EvaluatedContact, EvaluatedFile
from research.detection.tiles import tile_auc, tile_scores
from sonarpost.detection.detector import detect
from sonarpost.errors import SurveyFileError
from sonarpost.extensions.simulation.seabed.objects import ObjectKind
from sonarpost.extensions.simulation.seabed.survey import TruthObject
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.survey import Side, Survey


def target(kind=ObjectKind.SPHERE, ping=100, sample=300, side=Side.PORT):
    mine = kind not in (ObjectKind.BOULDER, ObjectKind.DEBRIS, ObjectKind.RIDGE)
    return TruthObject(kind, mine, side, ping, sample, 0.0, 0.0, 10.0, 2.0, 1.0, 0.5, 0.0)


def judged(*contacts, truth):
    return EvaluatedFile(SeabedKind.SAND, Survey(Path("x"), "x", "x", ()), (), contacts, truth, 1.0)


def test_contact_is_assigned_to_the_nearest_object_of_its_side():
    scale = simulated.Scale(0.1, 0.03)
    truth = (target(), target(ping=110), target(side=Side.STARBOARD), target(ObjectKind.DEBRIS, ping=400))
    assert simulated.object_at(truth, Side.PORT, 101, 300.0, scale) == 0
    assert simulated.object_at(truth, Side.PORT, 109, 300.0, scale) == 1
    assert simulated.object_at(truth, Side.STARBOARD, 109, 320.0, scale) == 2
    assert simulated.object_at(truth, Side.PORT, 130, 300.0, scale) is None
    assert simulated.object_at(truth, Side.PORT, 101, 360.0, scale) is None
    assert simulated.object_at(truth, Side.PORT, 420, 300.0, scale) == 3  # half its length farther


def test_each_object_counts_once_and_contacts_without_object_are_false_alarms():
    mine, other_mine, stone = target(), target(ping=500), target(ObjectKind.BOULDER, ping=800)
    contacts = [(1.8, mine), (1.7, mine), (1.5, None), (1.2, stone), (0.6, other_mine), (0.4, None)]
    each = (EvaluatedContact(confidence, item, confidence != 1.7) for confidence, item in contacts)
    one = judged(*each, truth=(mine, other_mine, stone))
    at = simulated.operating_point([one], 1.0)
    assert (at.pd, at.false_alarms_per_file, at.others_per_file) == (0.5, 1.0, 1.0)
    curve = simulated.roc([one])
    assert [simulated.pd_at(curve, n) for n in (0.0, 1.0, 2.0)] == [0.5, 1.0, 1.0]
    assert simulated.pd_at(simulated.roc([one], "cylinder"), 9.0) == 0.0
    bins = simulated.reliability([one], bins=2)
    assert [(b.contacts, b.true_share) for b in bins] == [(2, 0.5), (3, pytest.approx(1 / 3))]


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
    rows = [write_tile(tmp_path, "test", name, name == "t0_0.png") for name in ("t0_0.png", "c1_1.png")]
    (tmp_path / "index.csv").write_text("\n".join(["split,image,w,h,target_px,x0,y0,x1,y1", *rows]))
    tiles = tile_scores(tmp_path)
    assert [t.is_target for t in tiles] == [True, False]
    assert tile_auc(tiles)[0] == 1.0
    with pytest.raises(SurveyFileError, match="targets and others"):
        tile_auc(tiles[:1])


@pytest.fixture(scope="module")
def contact(make_survey):
    survey = make_survey({}, {"ping": 30, "side": Side.STARBOARD})
    found = next(d for d in detect(survey) if d.side is Side.PORT)
    one = contact_snippet(survey, found)
    assert one.confidence == pytest.approx(found.confidence, abs=0.1)
    return one


def test_codec_effect_has_one_result_a_budget_and_a_large_budget_keeps_the_confidence(contact):
    ((codec,), _) = create_codecs(comparison_registry(), ["spiht"])
    small, large = codec_effects([contact], codec, [16, 11_000])
    found = [(e.label, e.budget_bytes, e.coded, e.misses) for e in (small, large)]
    assert found == [("spiht", 16, 1, 0), ("spiht", 11_000, 1, 0)]
    assert large.before == contact.confidence
    assert large.after == pytest.approx(contact.confidence, abs=0.05)
    assert (large.kept, small.kept) == (1.0, float(small.after >= 1.0))
    (missed,) = codec_effects([contact], codec, [1])
    assert (missed.coded, missed.misses) == (0, 1)
    assert np.isnan(missed.after)


def test_image_without_the_object_has_no_confidence(contact):
    seabed = np.full_like(contact.snippet.image, int(np.median(contact.snippet.image)))
    assert confidence_with(contact.survey, contact.detection, contact.snippet, seabed) < 0.5 < contact.confidence


def bench(*arguments):
    return command.run(command.new_parser().parse_args([*map(str, arguments)]))


def test_last_line_is_the_json_object(monkeypatch, capsys):
    monkeypatch.setattr(command, "SeabedKind", (SeabedKind.MUD, SeabedKind.ROCK))
    assert bench("--files", 1, "--json") == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {"pd", "false_alarms_per_file", "auc_sdvd", "seconds_per_file"} <= set(result)
    assert result["pd"] >= 0.9
    assert result["false_alarms_per_file"] <= 1.0
    assert result["auc_sdvd"] is None
    assert result["seabeds"]["rock"]["false_alarms_per_file"] <= 6.0
