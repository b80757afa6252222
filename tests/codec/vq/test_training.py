"""Training windows, the Humminbird recording, the recipe of the shipped codebooks."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from builders.common import REPOSITORY

from sonarpost.cli.codebook.default_codebooks import RECIPES, Recipe, build_nominal, humminbird_images
from sonarpost.cli.codebook.humminbird_lines import humminbird_lines, read_channel
from sonarpost.codec.vq.codebook import to_bytes
from sonarpost.codec.vq.patches import PatchPlan, ToneMapping, cut_around, cut_line, reduce_line, shuffled, stretch
from sonarpost.codec.vq.training_config import Round
from sonarpost.errors import CodebookError, SonarpostError
from sonarpost.sonar.image_files import write_png

DATA = Path(os.environ.get("SONARPOST_DATA", REPOSITORY.parent / "shared" / "data"))


def line(pings: int = 300, samples: int = 260, seed: int = 0) -> np.ndarray:
    values = 50 * np.random.default_rng(seed).rayleigh(1.0, (pings, samples))
    return np.clip(values, 1, 255).astype(np.uint8).astype(np.float32)


def recording(folder: Path, channel: str, pings: list[np.ndarray]) -> None:
    data, index = b"", b""
    for number, ping in enumerate(pings):
        index += struct.pack(">II", number * 40, len(data))
        data += b"\xc0\xde\xab\x21" + bytes(57) + b"\xa0" + struct.pack(">I", ping.size) + b"\x21" + ping.tobytes()
    (folder / f"{channel}.SON").write_bytes(data)
    (folder / f"{channel}.IDX").write_bytes(index)


def test_a_tone_is_its_curve() -> None:
    assert ToneMapping(1.0, 1.0).table().tolist() == list(range(256))
    dark = ToneMapping(2.0, 0.5).table()
    assert (dark[0], dark[255], dark[128]) == (0, 128, 32)
    assert ToneMapping(1.0, 3.0).table()[-1] == 255


def test_stretching_puts_the_percentiles_at_the_ends() -> None:
    window = np.arange(10_000, dtype=float).reshape(100, 100)
    window[0, 0], window[-1, -1] = -1e6, 1e6  # a dropout and a flash do not count
    stretched = stretch(window)
    assert stretched.min() == 0
    assert stretched.max() == 255
    assert (stretched == 0).sum() == pytest.approx(100, abs=25)
    assert (stretched == 255).sum() == pytest.approx(50, abs=25)
    assert stretched[50, 50] == pytest.approx(255 * (5050 - 99) / (9949 - 99), abs=1)
    assert not stretch(np.full((9, 9), 7.0)).any()


def test_reducing_averages_blocks() -> None:
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    assert reduce_line(values, 2, 3).tolist() == [[4.0, 7.0], [16.0, 19.0]]
    assert reduce_line(values, 3, 4).shape == (1, 1)


def test_windows_avoid_what_was_not_recorded_and_what_is_flat() -> None:
    values = line()
    values[:, 160:] = np.nan
    values[:80, :80] = 40.0
    plan = PatchPlan(reductions=((1, 1),), tones=(ToneMapping(1.0, 1.0),))
    places = {image.name.split(" at ")[1].split(" #")[0] for image in cut_line("x", values, plan)}
    assert places == {"0,80", "80,0", "80,80", "160,0", "160,80"}
    assert all(image.load().shape == (80, 80) for image in cut_line("x", values, plan))


def test_windows_are_limited_repeated_in_other_tones_and_mirrored() -> None:
    plan = PatchPlan(reductions=((1, 1), (2, 2)), per_reduction=1, copies=3)
    images = list(cut_line("x", line(), plan))
    assert len(images) == 6
    assert len({image.name for image in images}) == 6
    assert len({image.load().tobytes() for image in images}) == 6
    plain = list(
        cut_line(
            "x", line(), PatchPlan(reductions=((1, 1),), per_reduction=1, tones=(ToneMapping(1.0, 1.0),), copies=4)
        )
    )
    first = plain[0].load()
    for image, expected in zip(plain, (first, first[::-1], first[:, ::-1], first[::-1, ::-1]), strict=True):
        assert np.array_equal(image.load(), expected)


def test_windows_around_an_object_show_it() -> None:
    values = line()
    values[140:150, 120:135] = 2000.0
    plan = PatchPlan(reductions=((1, 1), (2, 1), (9, 9)), copies=3)
    images = list(cut_around("x", values, [(145, 127)], plan))
    assert len(images) == 6  # reduced nine times the line is smaller than a window
    assert all((image.load() > 100).sum() > 40 for image in images)
    corner = list(cut_around("x", values, [(0, 0), (299, 259)], PatchPlan(reductions=((1, 1),))))
    assert [image.load().shape for image in corner] == [(80, 80), (80, 80)]


def test_the_order_depends_on_names_alone() -> None:
    images = list(cut_line("x", line(), PatchPlan()))
    assert [i.name for i in shuffled(images)] == [i.name for i in shuffled(images[::-1])]
    assert [i.name for i in shuffled(images)] != [i.name for i in images]


def test_a_recording_and_an_image_of_it_give_the_same_lines(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    folders = [tmp_path / "son" / "deeper", tmp_path / "png"]
    for folder in folders:
        folder.mkdir(parents=True)
    for channel in ("B002", "B003"):
        pings = [rng.integers(1, 256, rng.integers(20, 40), dtype=np.uint8) for _ in range(9)]
        recording(folders[0], channel, pings)
        image = read_channel(folders[0] / f"{channel}.SON")
        assert [row[row > 0].tolist() for row in image] == [ping.tolist() for ping in pings]
        write_png(folders[1] / f"some_{channel}_side.png", image)
    from_recording, from_images = humminbird_lines(tmp_path / "son"), humminbird_lines(folders[1])
    assert list(from_recording) == list(from_images) == ["humminbird B002", "humminbird B003"]
    for name, values in from_recording.items():
        assert np.array_equal(values, from_images[name], equal_nan=True)
        assert np.isnan(values).any()


def test_damaged_recordings_are_codebook_errors(tmp_path: Path) -> None:
    ping = np.arange(1, 30, dtype=np.uint8)
    recording(tmp_path, "B002", [ping] * 3)
    son, idx = tmp_path / "B002.SON", tmp_path / "B002.IDX"
    data, index = son.read_bytes(), idx.read_bytes()
    for position in (0, 61, 62, 66):
        son.write_bytes(data[:96] + data[96 : 96 + position] + b"\x77" + data[97 + position :])
        with pytest.raises(CodebookError, match="ping 1"):
            read_channel(son)
    for length in range(len(data)):
        son.write_bytes(data[:length])
        with pytest.raises(CodebookError):
            read_channel(son)
    son.write_bytes(data)
    for bad in (b"", index[:-1], struct.pack(">II", 0, 0xFFFFFFFF)):
        idx.write_bytes(bad)
        with pytest.raises(CodebookError):
            read_channel(son)
    idx.unlink()
    with pytest.raises(CodebookError, match="IDX"):
        read_channel(son)


def test_a_missing_or_ambiguous_channel_is_named(tmp_path: Path) -> None:
    with pytest.raises(CodebookError, match="B002"):
        humminbird_lines(tmp_path)
    for name in ("a_B002.png", "b_B002.png"):
        write_png(tmp_path / name, np.ones((4, 4), np.uint8))
    with pytest.raises(CodebookError, match="b_B002"):
        humminbird_lines(tmp_path)
    (tmp_path / "a_B002.png").write_bytes(b"no image")
    (tmp_path / "b_B002.png").unlink()
    with pytest.raises(SonarpostError, match="a_B002"):
        humminbird_lines(tmp_path)


def test_a_nominal_codebook_is_the_same_bytes_in_any_order_of_its_images() -> None:
    images = list(cut_line("x", line(), PatchPlan(copies=2)))
    recipe = Recipe(10, 200, (Round(39.0, 400.0, 10), Round(100.0, 60.0)), 2)
    one, other = build_nominal(recipe, images), build_nominal(recipe, images[::-1])
    assert to_bytes(one) == to_bytes(other)
    assert 100 < len(one.tiles) <= 200
    assert one.notes["refine passes"] == "2"


def test_the_recipes_fill_14_bit_codebooks_of_both_sizes() -> None:
    assert [recipe.tile_px for recipe in RECIPES] == [10, 20]
    assert all(recipe.max_tiles < 1 << 14 for recipe in RECIPES)
    assert sum(recipe.max_tiles * recipe.tile_px**2 for recipe in RECIPES) <= 8_000_000


@pytest.mark.realdata
def test_the_real_recording_is_read_as_its_images_are() -> None:
    if not (DATA / "surveys" / "humminbird").is_dir():
        pytest.skip(f"no recording under {DATA} (SONARPOST_DATA names the folder)")
    from_recording = humminbird_lines(DATA / "surveys" / "humminbird")
    from_images = humminbird_lines(DATA / "surveys" / "derived")
    for name, values in from_recording.items():
        assert values.shape == (3453, 1550)
        assert np.array_equal(values, from_images[name], equal_nan=True)


@pytest.mark.realdata
def test_the_real_recording_gives_windows_of_many_scales() -> None:
    if not (DATA / "surveys" / "derived").is_dir():
        pytest.skip(f"no recording under {DATA} (SONARPOST_DATA names the folder)")
    images = humminbird_images(DATA / "surveys" / "derived")
    assert len(images) > 2000
    assert all(image.load().shape == (80, 80) for image in images[::100])
