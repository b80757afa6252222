"""`python -m research.codecs`: pictures, misses, the JSON object, sheets and plots."""

from __future__ import annotations

import builtins
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from research.codecs import __main__ as command
from research.codecs.rate_distortion import RateDifference
from research.codecs.report import json_line
from research.common import measurement as measuring
from research.common.images import BenchPicture, read_folder, simulated_pictures
from research.common.measurement import Subject, code, measure
from research.common.sdvd import sdvd_crops, survey_line
from research.recognition.speckle import with_grain
from sonarpost.codec.interface import DecodedImage, StreamHeader
from sonarpost.codec.quality import psnr_db
from sonarpost.codec.vq.codebook import Codebook, save
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError, ConfigError, SonarpostError, StreamError, SurveyFileError
from sonarpost.sonar.image_files import write_png, write_tiff

Run = Callable[..., int]


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
    """A codec that keeps the means of square blocks, as small as the budget demands; refuses dark pictures."""

    name = "emb"
    codec_id = 0x7E
    model_hash = "ab" * 32

    def encode(self, image: np.ndarray, budget_bytes: int | None = None) -> bytes:
        if image.mean() < 20:
            raise StreamError("halving", "picture", "dark", "a bright one")
        header = StreamHeader(self.codec_id, 0xAB, *image.shape).pack()
        for block in (4, 8, 16, 32):
            rows, columns = -(-image.shape[0] // block), -(-image.shape[1] // block)
            if budget_bytes is None or len(header) + 1 + rows * columns <= budget_bytes:
                padded = np.pad(
                    image, ((0, rows * block - image.shape[0]), (0, columns * block - image.shape[1])), "edge"
                )
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


ROW_KEYS = {"codec", "budget", "bytes", "psnr", "ssim", "msssim", "encode_ms", "decode_ms"}


def test_the_json_object_has_exactly_these_keys(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
        if row["psnr"] is not None:
            assert 0 < row["bytes"] <= row["budget"]
            assert row["encode_ms"] > 0


def test_a_row_without_most_pictures_has_no_figures_but_the_details_do(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_png(folder / "dark.png", np.zeros((40, 48), np.uint8))
    monkeypatch.setattr("research.codecs.__main__.subjects", lambda *_, **__: ([Subject(Halving())], []))
    file = tmp_path / "details.json"
    assert run("--images", folder, "--budgets", "60,900", "--json", "--details", file) == 0
    said = capsys.readouterr()
    rows = json.loads(said.out)["results"]
    assert [row["psnr"] for row in rows] == [None, None]  # 3 of 4 pictures are fewer than nine tenths
    assert "emb at 900 B: 1 x picture: expected a bright one" in said.err
    found = json.loads(file.read_text())
    assert [(row["n"], row["misses"]) for row in found["results"]] == [(3, 1), (3, 1)]
    assert all(row["psnr"] > 0 and len(row["ci"]["psnr"]) == 2 for row in found["results"])
    assert found["pictures"] == 4


def test_of_vq_the_best_codebook_that_fits_a_budget_counts(folder: Path, tmp_path: Path) -> None:
    subjects, _ = measuring.subjects(measuring_registry(), ["vq"])
    pictures = read_folder(folder).pictures
    variants = [measure(subject, pictures, [])[0] for subject in subjects]
    coarse = next(p for p in variants if p.subject.variant == "nominal-20 14bit")
    fine = next(p for p in variants if p.subject.variant == "nominal-10 14bit")
    budgets = [int(coarse.stream_bytes.min()) - 1, int(coarse.stream_bytes.max()), 4096]
    none, small, large = measuring.best_that_fit(variants, budgets)
    assert none.misses == len(pictures)
    assert np.array_equal(small.stream_bytes, coarse.stream_bytes)
    assert np.array_equal(large.psnr, np.maximum(coarse.psnr, fine.psnr))
    assert (large.stream_bytes <= fine.stream_bytes).all()  # of the packings the tightest
    assert sum(none.reasons.values()) == len(pictures)


def test_vq_is_measured_with_any_codebook(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiles = np.random.default_rng(3).integers(0, 256, (9, 400), np.uint8)
    own = tmp_path / "own.tiles"
    save(own, Codebook(TileDatabase.from_tiles(20, tiles), {}))
    found = {}
    for codebook in (own, "nominal-20"):
        options = ("--images", folder, "--codecs", "vq", "--budgets", "90", "--json")
        assert run(*options, "--codebooks", codebook) == 0
        (found[codebook],) = json.loads(capsys.readouterr().out)["results"]
    assert found[own]["bytes"] == found["nominal-20"]["bytes"]
    assert found[own]["psnr"] < found["nominal-20"]["psnr"] - 1  # nine tiles of noise
    with pytest.raises(CodebookError, match=r"absent\.tiles"):
        run("--images", folder, "--codecs", "vq", "--codebooks", tmp_path / "absent.tiles")


def test_bd_rate_of_the_flagship_against_every_other(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    subjects = [Subject(Halving()), *measuring.subjects(measuring_registry(), ["spiht", "vq"])[0]]
    monkeypatch.setattr("research.codecs.__main__.subjects", lambda *_, **__: (subjects, []))
    file = tmp_path / "details.json"
    assert run("--images", folder, "--budgets", "24,44,88,192", "--json", "--details", file) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["bd_rate"]) == {"emb"}
    assert set(found["bd_rate"]["emb"]) == {"spiht", "vq"}
    assert found["bd_rate"]["emb"]["spiht"] > 0  # block means are no match for a wavelet
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


@pytest.mark.parametrize("option", ["--plot", "--sheet", "--details"])
def test_an_absent_folder_is_said_before_the_work(
    folder: Path, tmp_path: Path, option: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("research.codecs.__main__.measure", lambda *_: pytest.fail("measured"))
    with pytest.raises(ConfigError, match=f"{option}.*a folder that exists"):
        run("--images", folder, "--codecs", "huffman", option, tmp_path / "absent" / "file.png")


def measuring_registry():
    from sonarpost.codec.registry import default_registry

    return default_registry()


def test_what_cannot_be_compared_is_null() -> None:
    nothing = RateDifference(None, None, None, 0)
    assert json.loads(json_line([], 0, {"emb": {"vq": nothing}})) == {
        "images": 0,
        "results": [],
        "bd_rate": {"emb": {"vq": None}},
    }


def test_misses_are_counted_and_means_say_how_many_they_are_of() -> None:
    dark = np.zeros((40, 48), np.uint8)
    images = [snippet(0), dark, snippet(1), dark]
    pictures = [BenchPicture(str(i), str(i), image) for i, image in enumerate(images)]
    tight, roomy = measure(Subject(Halving()), pictures, [8, 200])
    assert tight.misses == 4
    assert np.isnan(tight.psnr).all()
    assert roomy.misses == 2
    assert list(roomy.hits) == [True, False, True, False]
    assert roomy.reasons["picture: expected a bright one"] == 2
    expected = Halving().decode(Halving().encode(images[0], 200)).image
    assert roomy.psnr[0] == psnr_db(images[0], expected)
    assert roomy.stream_bytes[0] == len(Halving().encode(images[0], 200)) <= 200


def test_a_miss_shows_in_the_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--images", folder, "--codecs", "jpeg2000", "--budgets", "40,400") == 0
    text = capsys.readouterr().out
    rows = {line.split()[1]: line.split() for line in text.splitlines() if line.startswith("jpeg2000 ")}
    assert rows["40"][2:4] == ["0", "3"]
    assert rows["400"][2:4] == ["3", "0"]
    assert "Misses (most frequent reason):" in text
    assert "jpeg2000 at 40 B: 3 x" in text
    assert "3 pictures of" in text


def test_streams_longer_than_their_budget_are_misses() -> None:
    class Greedy(Halving):
        def encode(self, image: np.ndarray, budget_bytes: int | None = None) -> bytes:
            return super().encode(image, None)

    assert code(Subject(Greedy()), snippet(0), [20]) == ["the stream is longer than its budget"]


def test_an_embedded_stream_is_made_once_and_cut() -> None:
    budgets: list[int | None] = []

    class Cut(Halving):
        def encode(self, image: np.ndarray, budget_bytes: int | None = None) -> bytes:
            budgets.append(budget_bytes)
            return StreamHeader(self.codec_id, 0xAB, *image.shape).pack() + bytes(range(100))

        def decode(self, stream: bytes, received: np.ndarray | None = None) -> DecodedImage:
            header = StreamHeader.unpack(stream)
            level = len(stream) - header.size
            return DecodedImage(
                np.full((header.height_px, header.width_px), level, np.uint8), np.zeros((1, 1), np.bool_)
            )

    coded = code(Subject(Cut(), is_embedded=True), snippet(0), [3, 30, 60])
    assert budgets == [60]
    assert isinstance(coded[0], str)  # not even the header fits
    assert [len(c.stream) for c in coded[1:] if not isinstance(c, str)] == [30, 60]
    levels = [int(c.rebuilt[0, 0]) for c in coded[1:] if not isinstance(c, str)]
    assert levels[1] - levels[0] == 30


def test_a_perfect_picture_has_a_finite_psnr() -> None:
    flat = BenchPicture("flat", "flat", np.full((32, 32), 77, np.uint8))
    (point,) = measure(Subject(Halving()), [flat], [100])
    assert point.psnr[0] == measuring.PSNR_LIMIT_DB
    assert math.isfinite(point.psnr[0])


def test_folders_are_read_at_any_depth_and_refusals_are_listed(folder: Path) -> None:
    write_png(folder / "too_small.png", snippet(0)[:15])
    write_png(folder / "too_wide.png", np.zeros((20, 513), np.uint8))
    Image.fromarray(np.dstack([snippet(0), snippet(1), snippet(2)])).save(folder / "colour.png")
    Image.fromarray(np.dstack([snippet(0), snippet(1), snippet(2)])).save(folder / "colour.jpg")
    (folder / "torn.png").write_bytes((folder / "a.png").read_bytes()[:60])
    (folder / "torn.jpg").write_bytes((folder / "deeper" / "c.JPG").read_bytes()[:200])
    (folder / "notes.txt").write_text("not a picture")
    found = read_folder(folder)
    assert [p.name for p in found.pictures] == ["a.png", "deeper/b.tiff", "deeper/c.JPG"]
    assert [p.pixels.dtype for p in found.pictures] == [np.uint8] * 3
    assert len(found.refused) == 6
    refused = "\n".join(found.refused)
    for name in ("too_small.png: height", "too_wide.png: width", "colour.png", "colour.jpg: colour", "torn.png"):
        assert name in refused
    assert "torn.jpg: JPEG data" in refused


def test_refusals_are_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_png(folder / "tall.png", np.zeros((600, 20), np.uint8))
    run("--images", folder, "--codecs", "spiht", "--budgets", "64")
    output = capsys.readouterr()
    assert "tall.png: height: got '600 px'" in output.err
    assert "1 refused" in output.out


def test_wrong_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SurveyFileError, match="not a folder"):
        run("--images", tmp_path / "absent")
    with pytest.raises(SurveyFileError, match="at least one grey"):
        run("--images", tmp_path)
    write_png(tmp_path / "small.png", np.zeros((8, 8), np.uint8))
    with pytest.raises(SurveyFileError, match=r"none, 1 refused.*small\.png: height"):
        run("--images", tmp_path)
    with pytest.raises(SurveyFileError, match=r"index\.csv"):
        run("--sdvd", tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        ["--budgets", "64,"],
        ["--budgets", "0"],
        ["--budgets", "1e3"],
        ["--budgets", "٣"],
        ["--codecs", "spiht,nothing"],
        ["--codecs", ""],
        ["--count", "0"],
        ["--crop", "15"],
        ["--crop", "501"],
        ["--seed", "-1"],
    ],
)
def test_wrong_options_are_refused(options: list[str]) -> None:
    with pytest.raises(ConfigError):
        run(*options)


def test_a_plot_without_matplotlib_is_refused_before_any_work(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    real = builtins.__import__

    def without(name: str, *rest: object, **more: object) -> object:
        if name.startswith("matplotlib"):
            raise ImportError(name)
        return real(name, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigError, match=r"sonarpost\[research\]"):
        run("--images", tmp_path / "absent", "--plot", tmp_path / "plot.png")


def test_plot_and_sheet(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is an optional extra")
    plot, sheet = tmp_path / "plot.png", tmp_path / "sheet.png"
    run(
        "--images",
        folder,
        "--codecs",
        "spiht,jpeg2000",
        "--budgets",
        "40,300",
        "--plot",
        plot,
        "--sheet",
        sheet,
    )
    with Image.open(plot) as picture:
        assert picture.width > 1000
        assert len(set(picture.convert("L").tobytes())) > 50
    with Image.open(sheet) as picture:
        drawn = np.asarray(picture.convert("L"))
    # The first row's first picture is the original, enlarged twice.
    first = snippet(0).repeat(2, 0).repeat(2, 1)
    assert np.array_equal(drawn[56 : 56 + first.shape[0], 20 : 20 + first.shape[1]], first)


def test_simulated_pictures_are_seeded_and_balanced(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("research.common.images._PINGS", 260)
    one, two = simulated_pictures(8, seed=5, side_px=64), simulated_pictures(8, seed=5, side_px=64)
    assert [p.is_target for p in one.pictures] == [True, False] * 4
    for a, b in zip(one.pictures, two.pictures, strict=True):
        assert a.pixels.shape == (64, 64)
        assert np.array_equal(a.pixels, b.pixels)
    other = simulated_pictures(8, seed=6, side_px=64)
    assert not np.array_equal(one.pictures[0].pixels, other.pictures[0].pixels)


def test_survey_lines_of_the_data_set() -> None:
    assert survey_line("left_20240430052854L_tile_4.png") == "202404300528"
    assert survey_line("right_20240430052859H_sample_2_tile_8.png") == "202404300528"
    assert survey_line("3_143.jpg") == "3"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "header"),
        ("split,image\ntest,a.png\n", "header"),
        ("split,image,w,h,target_px,x0,y0,x1,y1\nother,a.png,256,256,0,,,,\n", "split"),
        ("split,image,w,h,target_px,x0,y0,x1,y1\ntest,../a.png,256,256,0,,,,\n", "image"),
        ("split,image,w,h,target_px,x0,y0,x1,y1\ntest,a.png,256,256,9,1,2\n", "target_px"),
        ("split,image,w,h,target_px,x0,y0,x1,y1\ntest,a.png,256,256,many,,,,\n", "target_px"),
        ("split,image,w,h,target_px,x0,y0,x1,y1\ntrain,a.png,256,256,0,,,,\n", "no tile of 'test'"),
        ("split,image,w,h,target_px,x0,y0,x1,y1\ntest,absent.png,256,256,0,,,,\n", r"absent\.png"),
        ("split,image,w,h,target_px,x0,y0,x1,y1\ntest,small.png,256,256,0,,,,\n", "256 x 256 px"),
        ('split,image,w,h,target_px,x0,y0,x1,y1\ntest,"a\n', "text"),
    ],
)
def test_a_wrong_data_set_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "test" / "images").mkdir(parents=True)
    write_png(tmp_path / "test" / "images" / "small.png", np.zeros((64, 64), np.uint8))
    (tmp_path / "index.csv").write_text(text)
    with pytest.raises(SurveyFileError, match=message):
        sdvd_crops(tmp_path)


@pytest.mark.realdata
def test_the_crops_are_those_of_the_published_table(data_dir: Path) -> None:
    found = sdvd_crops(data_dir / "snippets" / "sdvd")
    assert len(found.pictures) == 138
    assert sum(bool(p.is_target) for p in found.pictures) == 92
    assert {p.pixels.shape for p in found.pictures} == {(80, 80)}
    assert np.stack([p.pixels for p in found.pictures]).mean() == pytest.approx(79.2210661, abs=1e-6)


def test_grain_is_shown_only_where_a_codec_offers_it() -> None:
    class Grainy(Halving):
        def decode_grain(self, stream: bytes) -> np.ndarray:
            if len(stream) < 20:
                raise StreamError("stream", "grain", stream, "grain in the stream")
            return np.array([[-300, -3], [10, 300]], np.int16)

    picture = np.full((2, 2), 100, np.uint8)
    assert with_grain(Halving(), bytes(40), picture) is None
    assert with_grain(Grainy(), bytes(10), picture) is None
    grain = with_grain(Grainy(), bytes(40), picture)
    assert grain is not None
    assert grain.tolist() == [[0, 98], [105, 250]]  # half of it, rounded down, clipped


def test_codecs_that_cannot_be_made_here_are_told_unless_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from sonarpost.codec.registry import CodecRegistry, CodecSpec

    def absent(_: object) -> Halving:
        raise ConfigError("codec rare", "library", "absent", "pip install rare")

    registry = CodecRegistry(
        [CodecSpec("rare", (0x90,), absent), CodecSpec("halving", (0x91,), lambda _: Halving(), is_embedded=True)],
    )
    found, left_out = measuring.subjects(registry, None)
    assert [subject.codec.codec_id for subject in found] == [0x7E]
    assert "pip install rare" in left_out[0]
    assert [measuring.subjects(registry, ["halving"], cut=cut)[0][0].is_embedded for cut in (False, True)] == [
        False,
        True,
    ]
    with pytest.raises(SonarpostError, match="pip install rare"):
        measuring.subjects(registry, ["rare"])
