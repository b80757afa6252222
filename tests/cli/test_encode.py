"""`sonarpost encode` and `sonarpost decode`."""

import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from builders import image_folders
from builders.image_folders import snippet
from rich.console import Console

from research.common.quality import psnr_db
from sonarpost.cli.main import parser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.errors import SonarpostError, StreamError
from sonarpost.sonar.image_files import read_image, write_png

Run = Callable[..., int]


@pytest.fixture
def run():
    def run_command(*arguments):
        parsed = parser(arguments[0]).parse_args([str(argument) for argument in arguments])
        status: int = parsed.run(parsed)
        return status

    return run_command


@pytest.fixture
def folder(tmp_path):
    return image_folders.three_images(tmp_path / "images")


@pytest.fixture
def own_images(tmp_path):
    return image_folders.own_images(tmp_path / "own")


@pytest.mark.parametrize(
    "options",
    [["--packing", "14bit"], ["--packing", "2byte", "--text"], ["--packing", "3byte"], ["--packing", "ascii5"]],
)
def test_folder_is_encoded_and_decoded(run, folder, options):
    assert run("encode", folder, "--codec", "vq", *options) == 0
    text = "--text" in options
    streams = sorted((folder / "streams").glob(f"*{'.txt' if text else '.vq'}"))
    assert [stream.stem for stream in streams] == ["a", "b", "c"]
    if text:
        assert set(streams[0].read_text()) <= set("0123456789abcdef\n")
    assert run("decode", folder) == 0
    for name, size in (("a", (60, 45)), ("b", (37, 81)), ("c", (60, 45))):
        image = read_image(folder / "out" / f"{name}.tiff")
        assert image.shape == size
        assert image.dtype == np.uint8
        assert np.array_equal(read_image(folder / "out" / f"{name}.png"), image)
    assert psnr_db(snippet(0), read_image(folder / "out" / "a.tiff")) > 14
    assert not list((folder / "out").glob("*missing*"))


def test_one_file_with_another_codebook_and_output_folder(run, folder, tmp_path):
    out = tmp_path / "new" / "deeper"
    assert run("encode", folder / "b.png", "--codec", "vq", "--codebook", "nominal-20", "--out", out) == 0
    assert [path.name for path in out.iterdir()] == ["b.vq"]
    # The decoder finds the shipped codebook by the tag in the stream.
    assert run("decode", out / "b.vq", "--out", tmp_path / "images") == 0
    assert read_image(tmp_path / "images" / "b.tiff").shape == (37, 81)
    with pytest.raises(StreamError, match="another identity"):
        run("decode", out / "b.vq", "--codebook", "nominal-10")


def test_invalid_files_of_a_folder_are_reported_and_the_others_processed(run, folder, capsys):
    (folder / "0bad.png").write_bytes(b"\x89PNG\r\n\x1a\n but no more")
    write_png(folder / "small.png", np.zeros((8, 8), np.uint8))
    write_png(folder / "a.png", snippet(5))  # the stem of a.tiff: one stream would overwrite the other
    assert run("encode", folder, "--codec", "vq") == 1
    output = capsys.readouterr()
    assert "3 of 6 files done" in output.out
    for name in ("0bad.png", "small.png", "a.tiff"):
        assert name in output.err
    assert "notes.md: not used" in output.err
    assert not list(folder.glob("*.vq")), "streams do not lie among the images"
    folder /= "streams"
    assert sorted(path.name for path in folder.iterdir()) == ["a.vq", "b.vq", "c.vq"]
    (folder / "a.vq").write_bytes(b"\x10\0")
    (folder / "d.txt").write_text("xyz")
    (folder / "e.md").write_text("xyz")
    assert run("decode", folder) == 1
    output = capsys.readouterr()
    assert "2 of 4 files done" in output.out
    assert "a.vq" in output.err
    assert "e.md: not used: not a stream" in output.err
    assert "hexadecimal" in output.err


def test_own_images_are_refused_with_the_way_out(run, own_images, capsys):
    with pytest.raises(SonarpostError, match="got '160 × 960 px', expected 16 to 512 px a side; --fit crop or"):
        run("encode", own_images / "phone.jpg", "--codec", "vq")
    assert run("encode", own_images, "--codec", "vq") == 1
    assert "1 of 3 files done" in capsys.readouterr().out


def test_own_images_are_encoded_with_a_note_for_each_change(run, own_images, capsys):
    assert run("encode", own_images, "--codec", "vq", "--fit", "resize") == 0
    output = capsys.readouterr()
    lines = {Path(line.split(" ->")[0]).name: line for line in output.out.splitlines() if " -> " in line}
    assert lines["phone.jpg"].endswith("turned by its orientation tag (6); 160 × 960 px resized to 85 × 512 px")
    assert "colour converted to grey (0.299 R + 0.587 G + 0.114 B)" in lines["colour.png"]
    assert "20 × 12 px resized to 27 × 16 px" in lines["small.tiff"]
    assert "heron.heic: not used" in output.err
    assert "not used: 1 *.txt beside images" in output.err
    assert f"sonarpost decode {own_images}\n" in output.out
    assert sorted(path.name for path in (own_images / "streams").iterdir()) == ["colour.vq", "phone.vq", "small.vq"]
    assert run("decode", own_images) == 0
    assert "85 × 512 px" in capsys.readouterr().out
    assert read_image(own_images / "out" / "phone.tiff").shape == (512, 85)
    assert run("encode", own_images, "--codec", "vq", "--fit", "resize") == 0
    assert "a folder, not searched" not in capsys.readouterr().err


def test_input_that_cannot_be_read_leaves_no_folder(run, tmp_path):
    (tmp_path / "empty.png").touch()
    for name in ("absent.png", "empty.png"):
        with pytest.raises(SonarpostError):
            run("encode", tmp_path / name)
    (tmp_path / "empty.vq").touch()
    with pytest.raises(SonarpostError):
        run("decode", tmp_path / "empty.vq")
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def test_crop_encodes_the_centre(run, own_images):
    assert run("encode", own_images / "phone.jpg", "--codec", "vq", "--fit", "crop", "--out", own_images / "s") == 0
    assert run("decode", own_images / "s" / "phone.vq") == 0
    assert read_image(own_images / "s" / "out" / "phone.tiff").shape == (512, 160)


def test_redirected_output_does_not_go_to_the_progress_bar(monkeypatch):
    terminal, output = io.StringIO(), io.StringIO()
    monkeypatch.setattr("sys.stdout", output)
    with ProgressDisplay(Console(file=terminal, force_terminal=True)) as display:
        display.show("encoding", 1, 2)
        print("a line of the result")
    assert output.getvalue() == "a line of the result\n"
    assert "encoding" in terminal.getvalue()


def test_missing_pixels_are_written_as_a_mask_and_reported(run, folder, capsys):
    run("encode", folder / "a.tiff", "--codec", "vq")
    folder /= "streams"
    stream = folder / "a.vq"
    stream.write_bytes(stream.read_bytes()[:-20])
    capsys.readouterr()
    assert run("decode", stream) == 0
    assert "missing (white in a.missing.png)" in capsys.readouterr().out
    mask = read_image(folder / "out" / "a.missing.png")
    assert set(np.unique(mask).tolist()) == {0, 255}
    assert not read_image(folder / "out" / "a.tiff")[mask == 255].any()


def test_invalid_input_is_a_sonarpost_error(run, folder, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "big.vq").write_bytes(bytes(1 << 19))
    (tmp_path / "file").write_text("")
    invalid = [
        ("encode", tmp_path / "absent.png"),
        ("encode", empty),
        ("encode", folder / "notes.md"),
        ("encode", folder / "a.tiff", "--codec", "zip"),
        ("encode", folder / "a.tiff", "--codec", "vq", "--codebook", tmp_path / "absent.tiles"),
        ("encode", folder / "a.tiff", "--codec", "vq", "--budget", 30),
        ("encode", folder / "a.tiff", "--out", tmp_path / "file" / "x"),
        ("decode", tmp_path / "absent.vq"),
        ("decode", tmp_path / "big.vq"),
        ("decode", folder, "--codebook", tmp_path / "absent.tiles"),
    ]
    for arguments in invalid:
        with pytest.raises(SonarpostError):
            run(*arguments)
