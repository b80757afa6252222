"""Recordings that are not part of the repository: what is derived from them, and the error without them."""

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.common import REPOSITORY

from research import prepare_data
from research.common.images import read_sdvd_index
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.sonar.image_files import read_image, write_png
from sonarpost.sonar.survey import Side


def sdvd_folder(root: Path) -> Path:
    folder = root / "snippets" / "sdvd"
    for split in ("train", "test"):
        (folder / split / "images").mkdir(parents=True)
        (folder / split / "masks").mkdir()
        mask = np.zeros((256, 256), np.uint8)
        write_png(folder / split / "images" / "b.png", mask)
        write_png(folder / split / "masks" / "b.png", mask)
        mask[10:30, 100:104] = 255
        mask[40, 40] = 127  # the edge of a JPEG: not part of the target
        write_png(folder / split / "images" / "a.png", mask)
        write_png(folder / split / "masks" / "a.png", mask)
    return folder


def test_index_has_the_boxes_of_the_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = sdvd_folder(tmp_path)
    assert prepare_data.main([str(tmp_path)]) == 0
    assert "index.csv: 4 tiles" in capsys.readouterr().out
    lines = (folder / "index.csv").read_text().splitlines()
    assert lines[1:3] == ["train,a.png,256,256,80,100,10,103,29", "train,b.png,256,256,0,,,,"]
    assert [(tile.split, tile.target_centre) for tile in read_sdvd_index(folder)] == [
        ("train", (101, 19)),
        ("train", None),
        ("test", (101, 19)),
        ("test", None),
    ]
    (folder / "test" / "masks" / "b.png").unlink()
    assert prepare_data.main([str(tmp_path)]) == 2
    assert "got 'no mask'" in capsys.readouterr().err


@pytest.mark.parametrize("bits", [8, 16])
def test_recordings_are_derived_as_images_and_compared(bits, tmp_path, capsys):
    survey = simulate_survey(SurveySpec(seed=1, pings=40, samples=128, targets=0, clutter=0, bits=bits)).survey
    (tmp_path / "surveys").mkdir()
    write_xtf(survey, tmp_path / "surveys" / "000_1236.xtf")
    assert prepare_data.main([str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "surveys/000_1236.xtf: another content" in output
    assert "surveys/scotsman-iver2.xtf: absent" in output
    port, starboard = (
        read_image(tmp_path / "surveys" / "derived" / f"000_1236.xtf.{side}.png") for side in ("port", "stbd")
    )
    assert port.dtype == f"u{bits // 8}"
    np.testing.assert_array_equal(port[:, ::-1], survey.waterfall(Side.PORT))
    np.testing.assert_array_equal(starboard, survey.waterfall(Side.STARBOARD))


@pytest.mark.realdata
def test_derived_files_are_those_of_the_published_figures(tmp_path: Path, data_dir: Path) -> None:
    sdvd = tmp_path / "snippets" / "sdvd"
    sdvd.mkdir(parents=True)
    for split in ("train", "test"):
        (sdvd / split).symlink_to(data_dir / "snippets" / "sdvd" / split)
    (tmp_path / "surveys").mkdir()
    (tmp_path / "surveys" / "scotsman-iver2.xtf").symlink_to(data_dir / "surveys" / "scotsman-iver2.xtf")
    assert prepare_data.main([str(tmp_path)]) == 0
    published = (data_dir / "snippets" / "sdvd" / "index.csv").read_text().splitlines()
    assert (sdvd / "index.csv").read_text().splitlines() == published
    for side in ("port", "stbd"):
        name = f"surveys/derived/scotsman-iver2.xtf.{side}.png"
        np.testing.assert_array_equal(read_image(tmp_path / name), read_image(data_dir / name))


@pytest.mark.parametrize(
    "command",
    [
        "prepare_data {}",
        "codecs.__main__ --sdvd {}",
        "recognition.__main__ --sdvd {}",
        "detection.__main__ --sdvd {}",
        "codebook.shipped --humminbird {} --out {}/out",
        "training.emb.pool --data {} --out {}/pool.npz",
        "training.emb.sheets --data {} --out {} 22",
    ],
)
def test_command_without_its_data_says_where_to_get_it(command: str, tmp_path: Path, monkeypatch, capsys) -> None:
    name, *arguments = command.replace("{}", str(tmp_path)).split()
    monkeypatch.setattr("sys.argv", [name, *arguments])
    assert importlib.import_module(f"research.{name}").main() == 2
    assert "research/README.md#data" in capsys.readouterr().err.splitlines()[-1]


def test_command_that_restarts_itself_says_where_to_get_its_data(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "research.codebook.adaptation_gain", "--data", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "research/README.md#data" in done.stderr.splitlines()[-1]
