"""`python -m research.paper` and `python -m research.recognition` with small data sets."""

import csv
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from research.common.images import SampleImage
from research.common.statistics import auc
from research.paper import __main__ as paper
from research.recognition import __main__ as recognition
from research.recognition.classifier import FOLDS, TargetClassifier
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.sonar.image_files import write_png
from sonarpost.sonar.survey import Survey


def run(command: ModuleType, *arguments: object) -> int:
    status: int = command.run(command.new_parser().parse_args([str(argument) for argument in arguments]))
    return status


def scene(seed: int, *, target: bool, side_px: int = 80) -> np.ndarray:
    """Return speckle, optionally with a target: a highlight and its shadow."""
    rng = np.random.default_rng(seed)
    image = 45 * rng.rayleigh(1.0, (side_px, side_px))
    if target:
        row, column = (int(v) for v in rng.integers(side_px // 2 - 10, side_px // 2, 2))
        image[row : row + 9, column : column + 9] *= 3.5
        image[row : row + 9, column + 9 : column + 26] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def labelled(count: int, first_seed: int = 0) -> list[SampleImage]:
    return [
        SampleImage(str(i), str(i), scene(first_seed + i, target=i % 2 == 0), f"{'tc'[i % 2]}{i % 20}", i % 2 == 0)
        for i in range(count)
    ]


@pytest.fixture(scope="module")
def classifier() -> TargetClassifier:
    return TargetClassifier(labelled(120), [], [])


def test_classifier_separates_targets_from_clutter_but_not_in_noise(classifier: TargetClassifier) -> None:
    test = labelled(60, first_seed=1000)
    is_target = np.array([bool(p.is_target) for p in test])
    groups = [p.group for p in test]
    areas = []
    for sigma in (0, 60, 600):
        rng = np.random.default_rng(sigma)
        noisy = [np.clip(p.pixels + rng.normal(0, sigma, p.pixels.shape), 0, 255).astype(np.uint8) for p in test]
        areas.append(auc(classifier.scores(noisy, groups), is_target)[0])
    assert areas[0] > 0.97
    assert areas[0] >= areas[1] >= areas[2]
    assert areas[2] < 0.8


def test_no_survey_line_is_classified_by_a_model_trained_on_it() -> None:
    # All labels of one line are inverted. A classifier that was not trained on this line gets all of them wrong.
    training = labelled(160)
    inverted = [
        SampleImage(f"inv {i}", f"inv {i}", scene(3000 + i, target=i % 2 == 0), "inverted", i % 2 == 1)
        for i in range(40)
    ]
    classifier = TargetClassifier([*training, *inverted], [], [])
    scores = classifier.scores([p.pixels for p in inverted], ["inverted"] * len(inverted))
    assert auc(scores, np.array([bool(p.is_target) for p in inverted]))[0] < 0.1


@pytest.fixture
def data_set(tmp_path: Path) -> Path:
    """Return a data set in the layout of SDVD: dated targets as PNG, numbered clutter as JPEG."""
    rows = []
    for split, count in (("train", 2 * FOLDS), ("test", 6)):
        images = tmp_path / split / "images"
        images.mkdir(parents=True)
        for i in range(count):
            tile = np.clip(45 * np.random.default_rng(i).rayleigh(1.0, (256, 256)), 0, 255)
            if i % 2 == 0:
                tile[110:132, 100:122] = 250
                tile[110:132, 122:170] = 5
                name, box = f"left_2024043005{i:02d}00L_tile_{i}.png", [100, 110, 170, 132]
                write_png(images / name, tile.astype(np.uint8))
            else:
                name, box = f"{i}_{i}.jpg", ["", "", "", ""]
                Image.fromarray(tile.astype(np.uint8)).save(images / name, quality=95)
            rows.append([split, name, 256, 256, 9 if i % 2 == 0 else 0, *box])
    with (tmp_path / "index.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["split", "image", "w", "h", "target_px", "x0", "y0", "x1", "y1"])
        writer.writerows(rows)
    return tmp_path


def test_recognition_results_of_decoded_images(data_set: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--sdvd", data_set, "--codecs", "spiht,jpeg2000", "--budgets", "12,128", "--simulated", "0"]
    originals, *others = recognition.measure(recognition.new_parser().parse_args([*map(str, options)]))
    assert originals.images == 12
    assert originals.area >= 0.93
    rows = {(one.label, one.budget_bytes): one for one in others}
    assert set(rows) == {("spiht", 12), ("spiht", 128), ("jpeg2000", 12), ("jpeg2000", 128)}
    assert rows["jpeg2000", 12].misses == 12
    assert rows["jpeg2000", 12].area is None
    assert rows["spiht", 128].images == 12
    low, high = rows["spiht", 128].ci
    assert 0 <= low <= rows["spiht", 128].area <= high <= 1
    assert run(recognition, *options) == 0
    assert "original" in capsys.readouterr().out


@pytest.fixture(scope="module")
def survey() -> Survey:
    return simulate_survey(SurveySpec(seed=11, pings=200, samples=512, targets=3, clutter=0)).survey


def test_page_contains_the_figures_of_the_run(survey, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib", reason="matplotlib is an optional extra")
    monkeypatch.setattr("research.common.images._PINGS", 260)
    write_xtf(survey, tmp_path / "line.xtf")
    options = ["--out", tmp_path, "--training", "4", "--codecs", "vq,spiht", "--survey", tmp_path / "line.xtf"]
    assert run(paper, *options) == 0
    assert "reproduction.md" in capsys.readouterr().out
    page = (tmp_path / "reproduction.md").read_text()
    for part in ("## Table II", "## Fig. 2", "## Fig. 3", "| 100 |", "codec jpeg2000 is not in", "line.xtf"):
        assert part in page
    for name in ("fig2.png", "fig3.png"):
        with Image.open(tmp_path / "reproduction" / name) as image:
            assert image.width > 400
    with pytest.raises(ConfigError, match="--training"):
        run(paper, "--out", tmp_path, "--training", "1")
    with pytest.raises(SurveyFileError):
        run(paper, "--out", tmp_path, "--survey", tmp_path / "absent.xtf")
