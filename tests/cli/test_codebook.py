"""`sonarpost codebook`, `sonarpost encode` and `sonarpost decode`."""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from sonarpost.cli import codebook, encode
from sonarpost.cli.codebook import parse_rounds
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.quality import psnr_db
from sonarpost.codec.vq.builder import Round
from sonarpost.codec.vq.codebook import load, load_default
from sonarpost.errors import CodebookError, ConfigError, SonarpostError, StreamError
from sonarpost.sonar.image_files import read_image, write_png, write_tiff

Run = Callable[..., int]


@pytest.fixture
def run():
    parser = argparse.ArgumentParser()
    subparsers = parser.add_subparsers()
    codebook.add_parser(subparsers)
    encode.add_parser(subparsers)

    def run_command(*arguments):
        parsed = parser.parse_args([str(argument) for argument in arguments])
        status: int = parsed.run(parsed)
        return status

    return run_command


def snippet(seed, height_px=60, width_px=45):
    image = 50 * np.random.default_rng(seed).rayleigh(1.0, (height_px, width_px))
    image[20:40, 10:20] *= 4
    image[20:40, 20:40] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.fixture
def folder(tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    write_tiff(images / "a.tiff", snippet(0))
    write_png(images / "b.png", snippet(1, 37, 81))
    write_tiff(images / "c.tif", snippet(2).astype(np.uint16) * 257)
    (images / "notes.md").write_text("not an image")
    return images


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


@pytest.fixture
def own_images(tmp_path):
    """Make a folder as a person has it: a large JPEG of a phone, a colour PNG, a small TIFF, a side-car, a note."""
    images = tmp_path / "own"
    images.mkdir()
    large = Image.fromarray(np.kron(snippet(3, 20, 120), np.ones((8, 8), np.uint8))).convert("RGB")
    exif = Image.Exif()
    exif[0x0112] = 6
    large.save(images / "phone.jpg", exif=exif)
    Image.fromarray(np.dstack([snippet(4), snippet(5), snippet(6)])).save(images / "colour.png")
    write_tiff(images / "small.tiff", snippet(7, 12, 20))
    (images / "phone.txt").write_text("lat_deg: 56.45\nlon_deg: -5.6\n")
    (images / "heron.heic").write_text("not an image")
    return images


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


def test_codebook_is_built_from_own_images(run, own_images, tmp_path, capsys):
    out = tmp_path / "own.tiles"
    assert run("codebook", "build", "--images", own_images, "--tile", 8, "--out", out, "--rounds", "90:40") == 0
    assert load(out).notes["images"] == "3"
    said = capsys.readouterr().err
    for text in ("heron.heic: not used", "colour.png: colour converted", "phone.jpg: turned"):
        assert text in said


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
        ("codebook", "info", tmp_path / "file"),
        ("codebook", "build", "--images", empty, "--out", tmp_path / "x.tiles"),
    ]
    for arguments in invalid:
        with pytest.raises(SonarpostError):
            run(*arguments)
    assert not (tmp_path / "x.tiles").exists()


def test_info_prints_a_shipped_codebook(run, capsys):
    assert run("codebook", "info", "nominal-10") == 0
    output = capsys.readouterr().out
    assert load_default(10).tiles.identity in output
    assert "10 × 10 px" in output


def test_codebook_is_built_from_a_folder_and_used(run, folder, tmp_path):
    out = tmp_path / "new" / "mine.tiles"
    (folder / "broken.tif").write_bytes(b"II*\0")
    assert run("codebook", "build", "--images", folder, "--tile", 8, "--out", out, "--rounds", "90:8,99:1:2") == 1
    built = load(out)
    assert built.notes["images"] == "3"
    assert built.tiles.tile_px == 8
    assert not out.with_name("mine.tiles.journal").exists()
    assert run("encode", folder / "a.tiff", "--codec", "vq", "--codebook", out) == 0
    with pytest.raises(CodebookError, match="SONARPOST_CODEBOOKS"):
        run("decode", folder / "streams" / "a.vq")
    assert run("decode", folder / "streams" / "a.vq", "--codebook", out) == 0
    # The codebook holds all tiles of the first image, so it is reconstructed exactly.
    assert np.array_equal(read_image(folder / "streams" / "out" / "a.tiff"), snippet(0))


def test_interrupted_build_is_resumed_only_with_the_option(run, folder, tmp_path, monkeypatch):
    out = tmp_path / "mine.tiles"
    arguments = ("codebook", "build", "--images", folder, "--out", out, "--rounds", "90:4", "--refine", 1)
    assert run(*arguments) == 0
    expected = out.read_bytes()
    out.unlink()

    def stop(display, progress):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ProgressDisplay, "build", stop)
        with pytest.raises(KeyboardInterrupt):
            run(*arguments)
    assert out.with_name("mine.tiles.journal").exists()
    with pytest.raises(CodebookError, match="--resume"):
        run(*arguments)
    assert run(*arguments, "--resume") == 0
    assert out.read_bytes() == expected


def test_rounds_are_parsed_in_grey_levels():
    assert parse_rounds("39:16", 20) == (Round(39.0, 320.0, None),)
    assert parse_rounds("30:40.5:500, 60:8", 10) == (Round(30.0, 405.0, 500), Round(60.0, 80.0, None))
    for text in ("", "39", "39:", "39:16:", "39:16:1.5", "39:-1", "nan:1", "39:16,", "39:16:5:5", "٣٩:16"):
        with pytest.raises(ConfigError, match="FOM:RMS"):
            parse_rounds(text, 10)


def test_codebooks_are_compared(run, folder, tmp_path, capsys):
    one, other = tmp_path / "one.tiles", tmp_path / "other.tiles"
    assert run("codebook", "build", "--images", folder / "a.tiff", "--tile", 8, "--out", one) == 0
    assert run("codebook", "build", "--images", folder / "b.png", "--tile", 8, "--out", other, "--core", one) == 0
    capsys.readouterr()
    assert run("codebook", "diff", one, one) == 0
    output = capsys.readouterr().out
    assert "the same" in output
    assert "principal angles up to 0.00 deg" in output
    assert run("codebook", "diff", one, other) == 1
    output = capsys.readouterr().out
    assert np.array_equal(load(other).tiles.tiles[: len(load(one).tiles)], load(one).tiles.tiles)
    assert load(one).tiles.identity in output
    assert load(other).tiles.identity in output
    assert "only in A      0 tiles" in output
    assert f"{len(load(one).tiles)} tiles have the same number in both" in output
    with pytest.raises(CodebookError, match="tile_px"):
        run("codebook", "diff", one, "nominal-10")


def test_codebook_is_adapted_to_a_folder(run, tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    for seed in range(8):
        write_png(images / f"{seed}.png", snippet(seed))
    base, out = tmp_path / "base.tiles", tmp_path / "out.tiles"
    run("codebook", "build", "--images", images / "0.png", "--tile", 8, "--out", base, "--max-tiles", 40)
    (images / "broken.tif").write_bytes(b"II*\0")
    capsys.readouterr()
    assert run("codebook", "adapt", base, "--images", images, "--out", out, "--keep", 10, "--max-tiles", 60) == 1
    output = capsys.readouterr()
    assert "broken.tif" in output.err.replace("\n", "")  # lines are wrapped at the terminal width
    assert "6 for training, 2 held out" in output.out
    assert "better in 2 of 2" in output.out
    adapted, original = load(out), load(base)
    assert adapted.notes["adapted from"].endswith(original.tiles.identity)
    assert adapted.notes["held-out PSNR dB"] in output.out
    assert len(adapted.tiles) == 60
    assert (adapted.tiles.tiles[:40] == original.tiles.tiles).all(axis=1).sum() >= 10
    with pytest.raises(ConfigError, match="keep"):
        run("codebook", "adapt", base, "--images", images, "--out", out, "--keep", 41)
    with pytest.raises(ConfigError, match="at least 2"):
        run("codebook", "adapt", base, "--images", images / "0.png", "--out", out)


def test_missing_gain_is_reported(run, tmp_path, capsys):
    images, base = tmp_path / "images", tmp_path / "base.tiles"
    images.mkdir()
    for number in range(2):
        write_png(images / f"{number}.png", np.full((24, 24), 90, np.uint8))
    run("codebook", "build", "--images", images / "0.png", "--tile", 8, "--out", base)
    capsys.readouterr()
    assert run("codebook", "adapt", base, "--images", images, "--out", tmp_path / "out.tiles") == 0
    output = capsys.readouterr()
    assert "no gain" in output.err
    assert "99.00 before, 99.00 after; better in 0 of 1" in output.out
