"""`python -m research.codecs`: images, misses, the JSON object, sheets and plots."""

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from research.codebook.basis import database_of
from research.codebook.codebook_file import save
from research.codecs import __main__ as command
from research.codecs.baselines import comparison_registry
from research.common import measurement as measuring
from research.common.images import SampleImage, read_image_folder, sdvd_crops, simulated_images
from research.common.measurement import CodecUnderTest, code_image, measure_codec
from research.common.quality import psnr_db
from research.common.scene_measures import PSNR_LIMIT_DB
from sonarpost.codec.interface import DecodedImage, StreamHeader
from sonarpost.codec.vq.codebook import Codebook
from sonarpost.errors import CodebookError, StreamError
from sonarpost.sonar.image_files import write_png, write_tiff


def run(*arguments: object) -> int:
    return command.run(command.new_parser().parse_args([str(argument) for argument in arguments]))


def snippet(seed: int, height_px: int = 40, width_px: int = 48) -> np.ndarray:
    image = 50 * np.random.default_rng(seed).rayleigh(1.0, (height_px, width_px))
    image[10:16, 8:14] *= 4
    image[10:16, 14:30] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    images = tmp_path / "images"
    (images / "deeper").mkdir(parents=True)
    write_png(images / "a.png", snippet(0))
    write_tiff(images / "deeper" / "b.tiff", snippet(1, 33, 57).astype(np.uint16) * 200)
    Image.fromarray(snippet(2)).save(images / "deeper" / "c.JPG", format="JPEG")
    return images


class Halving:
    """A codec that encodes the means of square blocks within the budget and rejects dark images."""

    name = "emb"
    codec_id = 0x7E
    model_hash = "ab" * 32

    def encode(self, image: np.ndarray, budget_bytes: int | None = None) -> bytes:
        if image.mean() < 20:
            raise StreamError("halving", "image", "dark", "a bright one")
        header = StreamHeader(self.codec_id, 0xAB, *image.shape).pack()
        for block in (4, 8, 16, 32):
            rows, columns = -(-image.shape[0] // block), -(-image.shape[1] // block)
            if budget_bytes is None or len(header) + 1 + rows * columns <= budget_bytes:
                more = ((0, rows * block - image.shape[0]), (0, columns * block - image.shape[1]))
                padded = np.pad(image, more, "edge")
                means = padded.reshape(rows, block, columns, block).mean((1, 3))
                return header + bytes([block]) + means.astype(np.uint8).tobytes()
        raise StreamError("halving", "budget_bytes", budget_bytes, "more")

    def decode(self, stream: bytes, received: np.ndarray | None = None) -> DecodedImage:
        header = StreamHeader.unpack(stream)
        block = stream[header.size]
        rows, columns = -(-header.height_px // block), -(-header.width_px // block)
        means = np.frombuffer(stream, np.uint8, offset=header.size + 1).reshape(rows, columns)
        image = means.repeat(block, 0).repeat(block, 1)[: header.height_px, : header.width_px]
        return DecodedImage(np.ascontiguousarray(image), np.zeros(image.shape, np.bool_))


ROW_KEYS = {"codec", "budget", "bytes", "psnr", "ssim", "msssim", "encode_ms", "decode_ms", *measuring.SCENE_MEASURES}
SIMULATED_KEYS = {"clean_psnr", "highlight_error", "shadow_error_px", "height_error"}


def test_json_object_has_the_documented_keys(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--images", folder, "--codecs", "spiht,vq", "--budgets", "128,16,44", "--json") == 0
    lines = capsys.readouterr().out.splitlines()
    found = json.loads(lines[-1])
    assert len(lines) == 1
    assert set(found) == {"images", "results", "bd_rate"}
    assert found["images"] == 3
    assert found["bd_rate"] == {}
    assert all(set(row) == ROW_KEYS for row in found["results"])
    assert [(r["codec"], r["budget"]) for r in found["results"]] == [
        (codec, budget) for codec in ("spiht", "vq") for budget in (16, 44, 128)
    ]
    for row in found["results"]:
        assert all(row[name] is None for name in SIMULATED_KEYS)
        if row["psnr"] is not None:
            assert 0 < row["bytes"] <= row["budget"]
            assert row["encode_ms"] > 0
            assert row["despeckled_psnr"] > row["psnr"]  # the speckle that coding removes is no error
            assert row["dots"] >= 0
        else:
            assert row["despeckled_psnr"] is row["dots"] is None


def test_rows_of_simulated_images_are_compared_with_their_scenes(capsys, monkeypatch):
    monkeypatch.setattr("research.common.images._PINGS", 260)
    monkeypatch.setattr(command, "simulated_images", cache(simulated_images))
    rows = {}
    for strength in ("0", "0.5", "1"):
        options = ("--count", 4, "--codecs", "emb,spiht", "--budgets", 128, "--json", "--strength", strength)
        assert run(*options) == 0
        rows[strength] = json.loads(capsys.readouterr().out)["results"]
    emb, spiht = zip(*rows.values(), strict=True)
    for row in (*emb, *spiht):
        assert set(row) == ROW_KEYS
        assert row["despeckled_psnr"] is None
        assert all(row[name] >= 0 for name in (*SIMULATED_KEYS, "dots"))
    assert emb[0]["clean_psnr"] < emb[1]["clean_psnr"] < emb[2]["clean_psnr"]
    assert emb[0]["psnr"] > emb[2]["psnr"]
    times = ("encode_ms", "decode_ms")
    others = [{name: value for name, value in row.items() if name not in times} for row in spiht]
    assert others[0] == others[1] == others[2]  # the strength affects emb only


def test_vq_uses_the_given_codebooks(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiles = np.random.default_rng(3).integers(0, 256, (9, 400), np.uint8)
    own = tmp_path / "own.tiles"
    save(own, Codebook(database_of(20, tiles), {}))
    found = {}
    for codebook in (own, "nominal-20"):
        options = ("--images", folder, "--codecs", "vq", "--budgets", "90", "--json")
        assert run(*options, "--codebooks", codebook) == 0
        (found[codebook],) = json.loads(capsys.readouterr().out)["results"]
    assert found[own]["bytes"] == found["nominal-20"]["bytes"]
    assert found[own]["psnr"] < found["nominal-20"]["psnr"] - 1  # nine tiles of noise
    with pytest.raises(CodebookError, match=r"absent\.tiles"):
        run("--images", folder, "--codecs", "vq", "--codebooks", tmp_path / "absent.tiles")


def test_bd_rate_compares_emb_with_every_other_codec(folder, tmp_path, capsys, monkeypatch):
    subjects = [CodecUnderTest(Halving()), *measuring.create_codecs(comparison_registry(), ["spiht", "vq"])[0]]
    monkeypatch.setattr("research.common.command.create_codecs", lambda *_, **__: (subjects, []))
    file = tmp_path / "details.json"
    assert run("--images", folder, "--budgets", "24,44,88,192", "--json", "--details", file) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["bd_rate"]) == {"emb"}
    assert set(found["bd_rate"]["emb"]) == {"spiht", "vq"}
    assert found["bd_rate"]["emb"]["spiht"] > 0  # block means are less efficient than a wavelet
    details = json.loads(file.read_text())
    assert details["bd_rate"]["emb"]["spiht"]["percent"] == pytest.approx(found["bd_rate"]["emb"]["spiht"], abs=0.01)
    gains = [row["emb_gain"]["psnr"]["mean"] for row in details["results"] if row["codec"] == "spiht"]
    assert len(gains) == 4
    assert all(gain < 0 for gain in gains)
    for row in details["results"]:
        for name, gain in row.get("emb_gain", {}).items():
            assert name in ("psnr", "ssim", "msssim")
            assert gain["mean"] is None or gain["ci"][0] <= gain["mean"] <= gain["ci"][1]
    assert all("emb_gain" not in row for row in details["results"] if row["codec"] == "emb")
    assert len(details["natural_sizes"]) == 8


def test_misses_are_counted_and_excluded_from_means() -> None:
    dark = np.zeros((40, 48), np.uint8)
    arrays = [snippet(0), dark, snippet(1), dark]
    images = [SampleImage(str(i), str(i), array) for i, array in enumerate(arrays)]
    tight, roomy = measure_codec(CodecUnderTest(Halving()), images, [8, 200])
    assert tight.misses == 4
    assert np.isnan(tight.psnr).all()
    assert roomy.misses == 2
    assert list(roomy.hits) == [True, False, True, False]
    assert roomy.reasons["image: expected a bright one"] == 2
    expected = Halving().decode(Halving().encode(arrays[0], 200)).image
    assert roomy.psnr[0] == psnr_db(arrays[0], expected)
    assert roomy.stream_bytes[0] == len(Halving().encode(arrays[0], 200)) <= 200

    class Greedy(Halving):
        def encode(self, image: np.ndarray, budget_bytes: int | None = None) -> bytes:
            return super().encode(image, None)

    assert code_image(CodecUnderTest(Greedy()), snippet(0), [20]) == ["the stream is longer than its budget"]
    flat = SampleImage("flat", "flat", np.full((32, 32), 77, np.uint8))
    (point,) = measure_codec(CodecUnderTest(Halving()), [flat], [100])
    assert point.psnr[0] == PSNR_LIMIT_DB
    assert math.isfinite(point.psnr[0])


def test_table_lists_misses_and_rejected_files_and_the_sheet_shows_originals(folder, tmp_path, capsys):
    write_png(folder / "tall.png", np.zeros((600, 20), np.uint8))
    sheet = tmp_path / "sheet.png"
    assert run("--images", folder, "--codecs", "jpeg2000", "--budgets", "40,400", "--sheet", sheet) == 0
    output = capsys.readouterr()
    assert "tall.png: size: got '20 × 600 px'" in output.err
    text = output.out
    assert "1 rejected" in text
    rows = {line.split()[1]: line.split() for line in text.splitlines() if line.startswith("jpeg2000 ")}
    assert rows["40"][2:4] == ["0", "3"]
    assert rows["400"][2:4] == ["3", "0"]
    assert "Misses (most frequent reason):" in text
    assert "jpeg2000 at 40 B: 3 x" in text
    assert "3 images of" in text
    with Image.open(sheet) as image:
        drawn = np.asarray(image.convert("L"))
    # The first image of the first row is the original, enlarged by two.
    first = snippet(0).repeat(2, 0).repeat(2, 1)
    assert np.array_equal(drawn[56 : 56 + first.shape[0], 20 : 20 + first.shape[1]], first)
    run("--images", folder, "--codecs", "spiht", "--budgets", "64", "--fit", "crop")
    output = capsys.readouterr()
    assert "tall.png: centre of 20 × 600 px cropped to 20 × 512 px" in output.err
    assert "rejected:" not in output.err


def test_folder_is_read_recursively_and_rejections_are_listed(folder: Path) -> None:
    write_png(folder / "too_small.png", snippet(0)[:15])
    write_png(folder / "too_wide.png", np.zeros((20, 513), np.uint8))
    Image.fromarray(np.dstack([snippet(0), snippet(1), snippet(2)])).save(folder / "colour.png")
    Image.fromarray(np.dstack([snippet(0), snippet(1), snippet(2)])).save(folder / "colour.jpg")
    (folder / "torn.png").write_bytes((folder / "a.png").read_bytes()[:60])
    (folder / "torn.jpg").write_bytes((folder / "deeper" / "c.JPG").read_bytes()[:200])
    (folder / "notes.txt").write_text("not an image")
    found = read_image_folder(folder)
    names = ["a.png", "colour.jpg", "colour.png", "deeper/b.tiff", "deeper/c.JPG"]
    assert [p.name for p in found.images] == names
    assert [p.pixels.dtype for p in found.images] == [np.uint8] * 5
    assert [Path(line.partition(":")[0]).name for line in found.notes] == ["colour.jpg", "colour.png"]
    assert len(found.rejected) == 5
    refused = "\n".join(found.rejected)
    for name in ("too_small.png: size", "too_wide.png: size", "torn.png", "torn.jpg: JPEG data", "notes.txt: not used"):
        assert name in refused
    fitted = read_image_folder(folder, "crop")
    assert [p.name for p in fitted.images] == [*names, "too_wide.png"]
    assert any("too_wide.png: centre of 513 × 20 px cropped to 512 × 20 px" in line for line in fitted.notes)


@pytest.mark.realdata
def test_crops_equal_those_of_the_published_table(data_dir: Path) -> None:
    found = sdvd_crops(data_dir / "snippets" / "sdvd")
    assert len(found.images) == 138
    assert sum(bool(p.is_target) for p in found.images) == 92
    assert {p.pixels.shape for p in found.images} == {(80, 80)}
    assert np.stack([p.pixels for p in found.images]).mean() == pytest.approx(79.2210661, abs=1e-6)
