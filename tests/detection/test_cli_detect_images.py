"""`sonarpost detect --images`."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from sonarpost.cli.main import main
from sonarpost.sonar.image_files import write_png, write_tiff


def picture(shape=(96, 128), seed=1):
    """Return seabed with an object and its shadow, uint8."""
    image = np.random.default_rng(seed).rayleigh(40, shape)
    image[40:52, 40:52] *= 4.0
    image[40:52, 52:90] *= 0.05
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Folder of one picture in several forms, and one of seabed alone."""
    folder = tmp_path / "images"
    folder.mkdir()
    image = picture()
    write_png(folder / "a.png", image)
    write_tiff(folder / "b12.tiff", image.astype(np.uint16) * np.uint16(16))
    write_png(folder / "c.png", np.ascontiguousarray(image[:, ::-1]))
    Image.fromarray(np.stack([image] * 3, axis=-1)).save(folder / "d.png")
    write_png(folder / "e.png", np.clip(np.random.default_rng(2).rayleigh(40, (96, 128)), 0, 255).astype(np.uint8))
    return folder


def scores(capsys):
    """Return the scores of the one line on standard output by the name of the file."""
    (line,) = capsys.readouterr().out.splitlines()
    images = json.loads(line)["images"]
    assert all(set(image) == {"file", "confidence", "p_mine_like"} for image in images)
    return {image["file"].rpartition("/")[2]: image for image in images}


def test_json_is_one_line_with_the_score_of_every_image(folder, capsys):
    assert main(["detect", "--images", str(folder), "--json"]) == 0
    found = scores(capsys)
    assert list(found) == ["a.png", "b12.tiff", "c.png", "d.png", "e.png"]
    assert found["a.png"]["file"] == str(folder / "a.png")
    for name in ("b12.tiff", "c.png", "d.png"):
        assert found[name]["confidence"] == pytest.approx(found["a.png"]["confidence"], abs=1e-3)
    assert found["a.png"]["confidence"] > 1.0 > 2 * found["e.png"]["confidence"]
    assert all(0 <= image["p_mine_like"] <= 1 for image in found.values())


def test_table_lists_the_most_confident_image_first(folder, capsys):
    assert main(["detect", "--images", str(folder)]) == 0
    title, heading, *lines = capsys.readouterr().out.splitlines()
    assert title == f"{folder}: 5 images"
    assert heading.split() == ["conf", "p_mine_like", "file"]
    assert lines[-1].split()[-1] == "e.png"


def test_invalid_files_are_reported_and_the_others_scored(folder, capsys):
    (folder / "broken.png").write_bytes(b"no image")
    write_png(folder / "small.png", picture()[:31])
    (folder / "notes.txt").write_text("notes")
    assert main(["detect", "--images", str(folder), "--json"]) == 2
    output = capsys.readouterr()
    assert len(json.loads(output.out)["images"]) == 5
    broken, small = [line for line in output.err.splitlines() if line.startswith("sonarpost:")]
    assert "broken.png: signature: got b'no image'" in broken
    assert "small.png: size: got '128 × 31 px', expected at least 32 px a side" in small
    assert "notes.txt: not used" in output.err


def test_conversions_are_counted(folder, capsys):
    colour = np.stack([picture(), picture(), picture() // 2], axis=-1)
    for name in ("f.png", "g.png"):
        Image.fromarray(colour).save(folder / name)
    assert main(["detect", "--images", str(folder), "--json"]) == 0
    assert f"note: {folder}: 2 images: colour converted to grey" in capsys.readouterr().err


def test_pixel_size_changes_the_score(folder, capsys):
    main(["detect", "--images", str(folder), "--json"])
    default = scores(capsys)
    main(["detect", "--images", str(folder), "--json", "--pixel-m", "0.05"])
    assert scores(capsys) == default
    main(["detect", "--images", str(folder), "--json", "--pixel-m", "0.4"])
    assert scores(capsys)["a.png"] != default["a.png"]


def test_flat_image_has_score_zero(tmp_path, capsys):
    write_png(tmp_path / "flat.png", np.full((40, 40), 7, np.uint8))
    assert main(["detect", "--images", str(tmp_path), "--json"]) == 0
    assert scores(capsys)["flat.png"]["confidence"] == 0.0


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ([], "detect: FILE: got 'nothing', expected survey files, or --images DIR"),
        (["a.xtf", "--images", "d"], "detect: FILE: got 'a.xtf', expected either survey files or --images d, not both"),
        (["a.xtf", "--pixel-m", "0.1"], "detect: --pixel-m: got 0.1, expected this option with --images DIR only"),
        (["--images", "d", "--plot", "x.png"], "detect: --plot: got 'x.png', expected this option with survey files"),
        (["--images", "d", "--max-contacts", "3"], "detect: --max-contacts: got '3', expected this option with survey"),
        (["--images", "d", "--pixel-m", "0"], "detect: --pixel-m: got 0.0, expected 0.005 to 1.0 m"),
        (["--images", "d", "--pixel-m", "nan"], "detect: --pixel-m: got nan, expected 0.005 to 1.0 m"),
        (["--images", "absent"], "absent: got 'no such folder'"),
    ],
)
def test_invalid_arguments_are_named(arguments, error, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["detect", *arguments]) == 2
    assert error in capsys.readouterr().err
