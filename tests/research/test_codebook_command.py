"""`python -m research.codebook`: build, info, diff, adapt."""

import numpy as np
import pytest
from builders import image_folders
from builders.image_folders import snippet

from research.codebook import __main__ as command
from research.codebook.__main__ import parse_rounds
from research.codebook.builder import BuildProgress, Round
from sonarpost.cli.main import main
from sonarpost.codec.vq.codebook import load, load_default
from sonarpost.errors import CodebookError, ConfigError, SonarpostError
from sonarpost.sonar.image_files import read_image, write_png


def run(*arguments):
    return command.run(command.new_parser().parse_args([str(argument) for argument in arguments]))


@pytest.fixture
def folder(tmp_path):
    return image_folders.three_images(tmp_path / "images")


def test_info_prints_a_shipped_codebook(capsys):
    assert run("info", "nominal-10") == 0
    output = capsys.readouterr().out
    assert load_default(10).tiles.identity in output
    assert "10 × 10 px" in output


def test_invalid_input_is_a_sonarpost_error(tmp_path, capsys):
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "file").write_text("")
    for arguments in (("info", tmp_path / "file"), ("build", "--images", empty, "--out", tmp_path / "x.tiles")):
        with pytest.raises(SonarpostError):
            run(*arguments)
        assert command.main([str(argument) for argument in arguments]) == 2
        assert capsys.readouterr().err.startswith("python -m research.codebook: ")
    assert not (tmp_path / "x.tiles").exists()


def test_codebook_is_built_from_own_images(tmp_path, capsys):
    own_images = image_folders.own_images(tmp_path / "own")
    out = tmp_path / "own.tiles"
    assert run("build", "--images", own_images, "--tile", 8, "--out", out, "--rounds", "90:40") == 0
    assert load(out).notes["images"] == "3"
    said = capsys.readouterr().err
    for text in ("heron.heic: not used", "colour.png: colour converted", "phone.jpg: turned"):
        assert text in said


def test_codebook_is_built_from_a_folder_and_used(folder, tmp_path, capsys):
    out = tmp_path / "new" / "mine.tiles"
    (folder / "broken.tif").write_bytes(b"II*\0")
    assert run("build", "--images", folder, "--tile", 8, "--out", out, "--rounds", "90:8,99:1:2") == 1
    built = load(out)
    assert built.notes["images"] == "3"
    assert built.tiles.tile_px == 8
    assert not out.with_name("mine.tiles.journal").exists()
    stream, codebook = str(folder / "streams" / "a.vq"), ("--codebook", str(out))
    assert main(["encode", str(folder / "a.tiff"), "--codec", "vq", *codebook]) == 0
    assert main(["decode", stream]) == 2
    assert "SONARPOST_CODEBOOKS" in capsys.readouterr().err
    assert main(["decode", stream, *codebook]) == 0
    # The codebook holds all tiles of the first image, so it is reconstructed exactly.
    assert np.array_equal(read_image(folder / "streams" / "out" / "a.tiff"), snippet(0))


def test_interrupted_build_is_resumed_only_with_the_option(folder, tmp_path, monkeypatch):
    out = tmp_path / "mine.tiles"
    arguments = ("build", "--images", folder, "--out", out, "--rounds", "90:4", "--refine", 1)
    assert run(*arguments) == 0
    expected = out.read_bytes()
    out.unlink()

    def stop(progress, display):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(BuildProgress, "show_on", stop)
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


def test_codebooks_are_compared(folder, tmp_path, capsys):
    one, other = tmp_path / "one.tiles", tmp_path / "other.tiles"
    assert run("build", "--images", folder / "a.tiff", "--tile", 8, "--out", one) == 0
    assert run("build", "--images", folder / "b.png", "--tile", 8, "--out", other, "--core", one) == 0
    capsys.readouterr()
    assert run("diff", one, one) == 0
    output = capsys.readouterr().out
    assert "the same" in output
    assert "principal angles up to 0.00 deg" in output
    assert run("diff", one, other) == 1
    output = capsys.readouterr().out
    assert np.array_equal(load(other).tiles.tiles[: len(load(one).tiles)], load(one).tiles.tiles)
    assert load(one).tiles.identity in output
    assert load(other).tiles.identity in output
    assert "only in A      0 tiles" in output
    assert f"{len(load(one).tiles)} tiles have the same number in both" in output
    with pytest.raises(CodebookError, match="tile_px"):
        run("diff", one, "nominal-10")


def test_codebook_is_adapted_to_a_folder(tmp_path, capsys):
    images = tmp_path / "images"
    images.mkdir()
    for seed in range(8):
        write_png(images / f"{seed}.png", snippet(seed))
    base, out = tmp_path / "base.tiles", tmp_path / "out.tiles"
    run("build", "--images", images / "0.png", "--tile", 8, "--out", base, "--max-tiles", 40)
    (images / "broken.tif").write_bytes(b"II*\0")
    capsys.readouterr()
    assert run("adapt", base, "--images", images, "--out", out, "--keep", 10, "--max-tiles", 60) == 1
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
        run("adapt", base, "--images", images, "--out", out, "--keep", 41)
    with pytest.raises(ConfigError, match="at least 2"):
        run("adapt", base, "--images", images / "0.png", "--out", out)


def test_missing_gain_is_reported(tmp_path, capsys):
    images, base = tmp_path / "images", tmp_path / "base.tiles"
    images.mkdir()
    for number in range(2):
        write_png(images / f"{number}.png", np.full((24, 24), 90, np.uint8))
    run("build", "--images", images / "0.png", "--tile", 8, "--out", base)
    capsys.readouterr()
    assert run("adapt", base, "--images", images, "--out", tmp_path / "out.tiles") == 0
    output = capsys.readouterr()
    assert "no gain" in output.err
    assert "99.00 before, 99.00 after; better in 0 of 1" in output.out
