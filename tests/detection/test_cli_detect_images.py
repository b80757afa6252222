"""`sonarpost detect --images`."""

import json

import numpy as np
import pytest
from PIL import Image

from sonarpost.cli.main import main
from sonarpost.sonar.image_files import write_png, write_tiff


def seabed_image(shape=(96, 128), seed=1):
    """Return seabed with an object and its shadow, uint8."""
    image = np.random.default_rng(seed).rayleigh(40, shape)
    image[40:52, 40:52] *= 4.0
    image[40:52, 52:90] *= 0.05
    return np.clip(image, 0, 255).astype(np.uint8)


def scores(capsys):
    """Return the scores of the one line on standard output by the name of the file, and standard error."""
    printed = capsys.readouterr()
    (line,) = printed.out.splitlines()
    images = json.loads(line)["images"]
    assert all(set(image) == {"file", "confidence", "p_mine_like"} for image in images)
    return {image["file"].rpartition("/")[2]: image for image in images}, printed.err


def test_json_is_one_line_with_the_score_of_every_image_and_invalid_files_are_reported(tmp_path, capsys):
    image = seabed_image()
    write_png(tmp_path / "a.png", image)
    write_tiff(tmp_path / "b12.tiff", image.astype(np.uint16) * np.uint16(16))
    write_png(tmp_path / "c.png", np.ascontiguousarray(image[:, ::-1]))
    Image.fromarray(np.stack([image, image, image // 2], axis=-1)).save(tmp_path / "d.png")
    write_png(tmp_path / "e.png", np.clip(np.random.default_rng(2).rayleigh(40, (96, 128)), 0, 255).astype(np.uint8))
    write_png(tmp_path / "flat.png", np.full((40, 40), 7, np.uint8))
    (tmp_path / "broken.png").write_bytes(b"no image")
    write_png(tmp_path / "small.png", image[:31])
    (tmp_path / "notes.txt").write_text("notes")
    assert main(["detect", "--images", str(tmp_path), "--json"]) == 2
    found, errors = scores(capsys)
    assert list(found) == ["a.png", "b12.tiff", "c.png", "d.png", "e.png", "flat.png"]
    assert found["a.png"]["file"] == str(tmp_path / "a.png")
    for name in ("b12.tiff", "c.png"):
        assert found[name]["confidence"] == pytest.approx(found["a.png"]["confidence"], abs=1e-3)
    assert found["a.png"]["confidence"] > 1.0 > 2 * found["e.png"]["confidence"]
    assert found["flat.png"]["confidence"] == 0.0
    assert all(0 <= each["p_mine_like"] <= 1 for each in found.values())
    broken, small = [line for line in errors.splitlines() if line.startswith("sonarpost:")]
    assert "broken.png: signature: got b'no image'" in broken
    assert "small.png: size: got '128 × 31 px', expected at least 32 px a side" in small
    assert "notes.txt: not used" in errors
    assert f"note: {tmp_path}: 1 images: colour converted to grey" in errors


def test_table_lists_the_most_confident_image_first_and_pixel_size_changes_the_score(tmp_path, capsys):
    write_png(tmp_path / "a.png", np.full((40, 40), 7, np.uint8))
    write_png(tmp_path / "b.png", seabed_image()[10:90, 10:100])
    assert main(["detect", "--images", str(tmp_path)]) == 0
    title, heading, *lines = capsys.readouterr().out.splitlines()
    assert title == f"{tmp_path}: 2 images"
    assert heading.split() == ["conf", "p_mine_like", "file"]
    assert [line.split()[-1] for line in lines] == ["b.png", "a.png"]
    confidences = []
    for options in ([], ["--pixel-m", "0.05"], ["--pixel-m", "0.06"]):
        assert main(["detect", "--images", str(tmp_path), "--json", *options]) == 0
        confidences.append(scores(capsys)[0]["b.png"]["confidence"])
    assert confidences[0] == confidences[1] != confidences[2]


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
