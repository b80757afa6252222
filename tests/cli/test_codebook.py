"""`sonarpost codebook`, `sonarpost encode` and `sonarpost decode`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

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
def run() -> Run:
    parser = argparse.ArgumentParser()
    subparsers = parser.add_subparsers()
    codebook.add_parser(subparsers)
    encode.add_parser(subparsers)

    def run_command(*arguments: object) -> int:
        parsed = parser.parse_args([str(argument) for argument in arguments])
        status: int = parsed.run(parsed)
        return status

    return run_command


def snippet(seed: int, height_px: int = 60, width_px: int = 45) -> np.ndarray:
    image = 50 * np.random.default_rng(seed).rayleigh(1.0, (height_px, width_px))
    image[20:40, 10:20] *= 4
    image[20:40, 20:40] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    images = tmp_path / "images"
    images.mkdir()
    write_tiff(images / "a.tiff", snippet(0))
    write_png(images / "b.png", snippet(1, 37, 81))
    write_tiff(images / "c.tif", snippet(2).astype(np.uint16) * 257)
    (images / "notes.md").write_text("not an image")
    return images


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("packing", ["14bit", "2byte", "3byte", "ascii5"])
def test_folder_is_encoded_and_decoded(run: Run, folder: Path, text: bool, packing: str) -> None:
    assert run("encode", folder, "--codec", "vq", "--packing", packing, *(["--text"] if text else [])) == 0
    suffix = ".txt" if text else ".vq"
    streams = sorted(folder.glob(f"*{suffix}"))
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


def test_one_file_with_another_codebook_and_output_folder(run: Run, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "deeper"
    assert run("encode", folder / "b.png", "--codec", "vq", "--codebook", "nominal-20", "--out", out) == 0
    assert [path.name for path in out.iterdir()] == ["b.vq"]
    # The decoder finds the shipped codebook by the tag in the stream.
    assert run("decode", out / "b.vq", "--out", tmp_path / "pictures") == 0
    assert read_image(tmp_path / "pictures" / "b.tiff").shape == (37, 81)
    with pytest.raises(StreamError, match="another identity"):
        run("decode", out / "b.vq", "--codebook", "nominal-10")


def test_invalid_files_of_a_folder_are_reported_and_the_others_processed(
    run: Run, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "0bad.png").write_bytes(b"\x89PNG\r\n\x1a\n but no more")
    write_png(folder / "small.png", np.zeros((8, 8), np.uint8))
    write_png(folder / "a.png", snippet(5))  # the stem of a.tiff: one stream would overwrite the other
    assert run("encode", folder, "--codec", "vq") == 1
    output = capsys.readouterr()
    assert "3 of 6 files done" in output.out
    for name in ("0bad.png", "small.png", "a.tiff"):
        assert name in output.err
    assert sorted(path.name for path in folder.glob("*.vq")) == ["a.vq", "b.vq", "c.vq"]
    (folder / "a.vq").write_bytes(b"\x10\0")
    (folder / "d.txt").write_text("xyz")
    assert run("decode", folder) == 1
    output = capsys.readouterr()
    assert "2 of 4 files done" in output.out
    assert "a.vq" in output.err
    assert "hexadecimal" in output.err


def test_missing_pixels_are_written_as_a_mask_and_reported(
    run: Run, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("encode", folder / "a.tiff", "--codec", "vq")
    stream = folder / "a.vq"
    stream.write_bytes(stream.read_bytes()[:-20])
    capsys.readouterr()
    assert run("decode", stream) == 0
    assert "missing (white in a.missing.png)" in capsys.readouterr().out
    mask = read_image(folder / "out" / "a.missing.png")
    assert set(np.unique(mask).tolist()) == {0, 255}
    assert not read_image(folder / "out" / "a.tiff")[mask == 255].any()


def test_invalid_input_is_a_sonarpost_error(run: Run, folder: Path, tmp_path: Path) -> None:
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


def test_codecs_are_listed(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("encode", "unused", "--codec", "help") == 0
    assert "vector quantisation" in capsys.readouterr().out


def test_info_prints_a_shipped_codebook(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("codebook", "info", "nominal-10") == 0
    output = capsys.readouterr().out
    assert load_default(10).tiles.identity in output
    assert "10 x 10 px" in output
    assert run("codebook") == 0
    assert "build" in capsys.readouterr().out


def test_codebook_is_built_from_a_folder_and_used(run: Run, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine.tiles"
    (folder / "broken.tif").write_bytes(b"II*\0")
    assert run("codebook", "build", "--images", folder, "--tile", 8, "--out", out, "--rounds", "90:8,99:1:2") == 1
    built = load(out)
    assert built.notes["images"] == "3"
    assert built.tiles.tile_px == 8
    assert not out.with_name("mine.tiles.journal").exists()
    assert run("encode", folder / "a.tiff", "--codec", "vq", "--codebook", out) == 0
    with pytest.raises(CodebookError, match="SONARPOST_CODEBOOKS"):
        run("decode", folder / "a.vq")
    assert run("decode", folder / "a.vq", "--codebook", out) == 0
    # The codebook holds all tiles of the first image, so it is reconstructed exactly.
    assert np.array_equal(read_image(folder / "out" / "a.tiff"), snippet(0))
    more = tmp_path / "more.tiles"
    assert run("codebook", "build", "--images", folder / "b.png", "--tile", 8, "--out", more, "--core", out) == 0
    assert np.array_equal(load(more).tiles.tiles[: len(built.tiles)], built.tiles.tiles)


def test_interrupted_build_is_resumed_only_with_the_option(run: Run, folder: Path, tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "mine.tiles"
    arguments = ("codebook", "build", "--images", folder, "--out", out, "--rounds", "90:4", "--refine", 1)
    assert run(*arguments) == 0
    expected = out.read_bytes()
    out.unlink()

    def stop(display: ProgressDisplay, progress: object) -> None:
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


def test_rounds_are_parsed_in_grey_levels() -> None:
    assert parse_rounds("39:16", 20) == (Round(39.0, 320.0, None),)
    assert parse_rounds("30:40.5:500, 60:8", 10) == (Round(30.0, 405.0, 500), Round(60.0, 80.0, None))
    for text in ("", "39", "39:", "39:16:", "39:16:1.5", "39:-1", "nan:1", "39:16,", "39:16:5:5", "٣٩:16"):
        with pytest.raises(ConfigError, match="FOM:RMS"):
            parse_rounds(text, 10)


def test_codebooks_are_compared(run: Run, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
    assert load(one).tiles.identity in output
    assert load(other).tiles.identity in output
    assert "only in A      0 tiles" in output
    assert f"{len(load(one).tiles)} tiles have the same number in both" in output
    with pytest.raises(CodebookError, match="tile_px"):
        run("codebook", "diff", one, "nominal-10")


def test_codebook_is_adapted_to_a_folder(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_missing_gain_is_reported(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for number in range(2):
        write_png(images / f"{number}.png", np.full((24, 24), 90, np.uint8))
    base = tmp_path / "base.tiles"
    run("codebook", "build", "--images", images / "0.png", "--tile", 8, "--out", base)
    capsys.readouterr()
    assert run("codebook", "adapt", base, "--images", images, "--out", tmp_path / "out.tiles") == 0
    output = capsys.readouterr()
    assert "no gain" in output.err
    assert "99.00 before, 99.00 after; better in 0 of 1" in output.out
