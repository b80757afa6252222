"""The shipped codebooks: the Humminbird recording, the recipes, `python -m research.codebook.shipped`."""

import struct
from pathlib import Path

import numpy as np
import pytest
from builders.images import speckle_line

from research.codebook import shipped
from research.codebook.builder import Round
from research.codebook.shipped import Recipe, build_nominal, humminbird_images, humminbird_lines, read_channel
from research.common.patches import PatchPlan, cut_line
from sonarpost.codec.vq.codebook import load, to_bytes
from sonarpost.codec.vq.tiles import cut_tiles
from sonarpost.errors import SonarpostError
from sonarpost.sonar.image_files import write_png


def run(*arguments: object) -> int:
    parsed = shipped.new_parser().parse_args([str(argument) for argument in arguments])
    return shipped.run(parsed)


def recording(folder: Path, channel: str, pings: list[np.ndarray]) -> None:
    data, index = b"", b""
    for number, ping in enumerate(pings):
        index += struct.pack(">II", number * 40, len(data))
        data += b"\xc0\xde\xab\x21" + bytes(57) + b"\xa0" + struct.pack(">I", ping.size) + b"\x21" + ping.tobytes()
    (folder / f"{channel}.SON").write_bytes(data)
    (folder / f"{channel}.IDX").write_bytes(index)


def test_refinement_passes_are_an_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    speckle = 60 * np.random.default_rng(4).rayleigh(1.0, (170, 170))
    images = list(cut_line("x", speckle.astype(np.float32), PatchPlan(copies=2)))
    monkeypatch.setattr(shipped, "humminbird_images", lambda _: images)
    monkeypatch.setattr(shipped, "simulated_images", lambda _: iter(()))
    monkeypatch.setattr(shipped, "RECIPES", (Recipe(10, 80, (Round(100.0, 60.0),), 2),))
    made = []
    for options in (("--refine", 0), ("--refine", 2), ()):
        assert run("--humminbird", tmp_path, "--out", tmp_path / "new" / "folder", *options) == 0
        made.append(load(tmp_path / "new" / "folder" / "nominal-10.tiles"))
    alone, twice, usual = made
    assert twice.tiles.identity == usual.tiles.identity != alone.tiles.identity
    assert [one.notes["refine passes"] for one in made] == ["0", "2", "2"]
    pieces = {tile.tobytes() for image in images for tile in cut_tiles(image.load(), 10)}
    assert all(tile.tobytes() in pieces for tile in alone.tiles.tiles)  # Table IV keeps tiles as they are
    (tmp_path / "file").touch()
    with pytest.raises(SonarpostError, match="--out"):
        run("--humminbird", tmp_path, "--out", tmp_path / "file" / "folder")


def test_recording_and_images_of_it_give_the_same_lines(tmp_path: Path) -> None:
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


def test_codebook_bytes_do_not_depend_on_the_order_of_images() -> None:
    images = list(cut_line("x", speckle_line(170, 170), PatchPlan(copies=2)))
    recipe = Recipe(10, 200, (Round(39.0, 400.0, 10), Round(100.0, 60.0)), 2)
    one, other = build_nominal(recipe, images), build_nominal(recipe, images[::-1])
    assert to_bytes(one) == to_bytes(other)
    assert 100 < len(one.tiles) <= 200
    assert one.notes["refine passes"] == "2"


@pytest.mark.realdata
def test_real_recording_and_its_images_give_the_same_lines_and_training_images(data_dir: Path) -> None:
    from_recording = humminbird_lines(data_dir / "surveys" / "humminbird")
    from_images = humminbird_lines(data_dir / "surveys" / "derived")
    for name, values in from_recording.items():
        assert values.shape == (3453, 1550)
        assert np.array_equal(values, from_images[name], equal_nan=True)
    images = humminbird_images(data_dir / "surveys" / "derived")
    assert len(images) > 2000
    assert all(image.load().shape == (80, 80) for image in images[::100])
