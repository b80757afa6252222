"""JPEG XL, AVIF and WebP: budgets, golden streams, omitted headers, sizes, damage, missing libraries."""

from __future__ import annotations

import io

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from sonarpost.codec.baselines.still_images import (
    StillImageCodec,
    StillImageFormat,
    av1_sequence_size,
    avif_body,
    avif_file,
    check_av1_frame,
    jpegxl_size,
    webp_body,
    webp_file,
)
from sonarpost.codec.interface import StreamHeader
from sonarpost.codec.quality import psnr_db
from sonarpost.codec.registry import BUILTINS, CodecRegistry
from sonarpost.errors import ConfigError, StreamError

GOLDEN = GOLDEN_FOLDER / "modern"


def parameter(image_format: StillImageFormat) -> object:
    absent = pytest.mark.skipif(
        not image_format.available, reason=f"{image_format.value} needs {image_format.requirement}"
    )
    return pytest.param(image_format, id=image_format.value, marks=absent)


EACH_FORMAT = pytest.mark.parametrize("image_format", [parameter(image_format) for image_format in StillImageFormat])


def body(stream: bytes) -> bytes:
    return stream[StreamHeader.unpack(stream).size :]


def golden_names(image_format: StillImageFormat) -> list[str]:
    return sorted(path.stem for path in GOLDEN.glob(f"{image_format.value}-*.hex") if not path.stem.endswith("picture"))


@EACH_FORMAT
def test_golden_streams_are_decoded(image_format: StillImageFormat) -> None:
    names = golden_names(image_format)
    assert len(names) == 3
    for name in names:
        stream = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
        expected = np.frombuffer(bytes.fromhex((GOLDEN / f"{name}-picture.hex").read_text()), np.uint8)
        decoded = StillImageCodec(image_format).decode(stream)
        # WebP and AVIF are exact but converted to grey through RGB; JPEG XL is floating point.
        assert np.abs(decoded.image.ravel().astype(int) - expected).max() <= 2
        assert not decoded.missing.any()


@EACH_FORMAT
def test_best_quality_within_the_budget_is_sent(image_format: StillImageFormat) -> None:
    codec, image = StillImageCodec(image_format), snippet(80, 80)
    quality = []
    for budget in (1200, 2000, 3500):
        stream = codec.encode(image, budget)
        assert budget / 3 < len(stream) <= budget
        quality.append(psnr_db(image, codec.decode(stream).image))
    assert quality == sorted(quality)
    assert quality[-1] > quality[0] + 2


@EACH_FORMAT
def test_budget_is_met_to_the_byte(image_format: StillImageFormat) -> None:
    image = snippet(48, 48)
    for quality in (20, 49, 60):
        length = len(StillImageCodec(image_format, quality).encode(image))
        assert len(StillImageCodec(image_format).encode(image, length)) <= length
        assert len(StillImageCodec(image_format).encode(image, length - 1)) < length


def test_quality_search_is_near_the_optimum() -> None:
    if not StillImageFormat.WEBP.available:
        pytest.skip("no WebP in this Pillow")
    image = snippet(48, 64)
    streams = [StillImageCodec(StillImageFormat.WEBP, quality).encode(image) for quality in range(100)]
    reached = [psnr_db(image, StillImageCodec(StillImageFormat.WEBP).decode(stream).image) for stream in streams]
    for budget in (400, 700, 1500):
        best = max(db for db, stream in zip(reached, streams, strict=True) if len(stream) <= budget)
        sent = StillImageCodec(StillImageFormat.WEBP).encode(image, budget)
        assert psnr_db(image, StillImageCodec(StillImageFormat.WEBP).decode(sent).image) > best - 0.5


@EACH_FORMAT
def test_budget_below_the_lowest_quality_is_rejected(image_format: StillImageFormat) -> None:
    for budget in (0, 22, 60):
        with pytest.raises(StreamError, match=f"codec {image_format.value}: budget_bytes"):
            StillImageCodec(image_format).encode(snippet(80, 80), budget)


@EACH_FORMAT
def test_higher_quality_gives_a_smaller_error(image_format: StillImageFormat) -> None:
    image = snippet(64, 100)
    reached = [
        psnr_db(
            image,
            StillImageCodec(image_format, quality).decode(StillImageCodec(image_format, quality).encode(image)).image,
        )
        for quality in (5, 50, 99)
    ]
    assert reached == sorted(reached)
    assert reached[-1] > 30


@EACH_FORMAT
@pytest.mark.parametrize("quality", [-1, 100])
def test_quality_out_of_range_is_rejected(image_format: StillImageFormat, quality: int) -> None:
    with pytest.raises(ConfigError, match="quality"):
        StillImageCodec(image_format, quality)


@EACH_FORMAT
@pytest.mark.parametrize("size", [(16, 16), (17, 31), (16, 512), (511, 33)])
def test_every_size_round_trips(image_format: StillImageFormat, size: tuple[int, int]) -> None:
    image = snippet(*size)
    decoded = StillImageCodec(image_format).decode(StillImageCodec(image_format).encode(image))
    assert psnr_db(image, decoded.image) > 18


@EACH_FORMAT
def test_body_of_another_size_is_rejected(image_format: StillImageFormat) -> None:
    if image_format is StillImageFormat.WEBP:
        pytest.skip("a WebP body has no size of its own")
    stream = StillImageCodec(image_format).encode(snippet(60, 80))
    with pytest.raises(StreamError, match="size"):
        StillImageCodec(image_format).decode(StreamHeader(image_format.codec_id, 0, 80, 60).pack() + body(stream))


@EACH_FORMAT
def test_damaged_body_decodes_or_is_rejected_without_output(
    image_format: StillImageFormat, capfd: pytest.CaptureFixture[str]
) -> None:
    codec = StillImageCodec(image_format, 5)
    stream = codec.encode(snippet(33, 47))
    rejected = 0
    for at in range(5, len(stream), 3):
        damaged = bytearray(stream)
        damaged[at] ^= 0x5A
        for data in (bytes(damaged), stream[:at]):
            try:
                assert codec.decode(data).image.shape == (33, 47)
            except StreamError:
                rejected += 1
    assert rejected >= len(range(5, len(stream), 3)) / 2
    assert capfd.readouterr() == ("", "")


@EACH_FORMAT
@given(junk=st.binary(max_size=200))
@settings(max_examples=40, deadline=None)
def test_any_body_decodes_or_is_rejected(image_format: StillImageFormat, junk: bytes) -> None:
    try:
        decoded = StillImageCodec(image_format).decode(StreamHeader(image_format.codec_id, 0, 48, 32).pack() + junk)
    except StreamError:
        return
    assert decoded.image.shape == (48, 32)


@EACH_FORMAT
def test_gap_makes_all_pixels_missing(image_format: StillImageFormat) -> None:
    codec = StillImageCodec(image_format)
    stream = codec.encode(snippet(48, 48))
    received = np.ones(len(body(stream)), np.bool_)
    assert np.array_equal(codec.decode(stream, received).image, codec.decode(stream).image)
    with pytest.raises(StreamError):  # damage is not a gap
        codec.decode(stream[:-20], received[:-20])
    received[8:] = False
    decoded = codec.decode(stream, received)
    assert decoded.missing.all()
    assert not decoded.image.any()
    assert "nothing can be decoded" in decoded.notes[1]


@EACH_FORMAT
def test_registry_creates_the_codec(image_format: StillImageFormat) -> None:
    codec = CodecRegistry(BUILTINS).create(image_format.value)
    assert (codec.name, codec.codec_id) == (image_format.value, image_format.codec_id)


@pytest.mark.parametrize("image_format", list(StillImageFormat), ids=lambda image_format: image_format.value)
def test_error_names_the_missing_library(image_format: StillImageFormat, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StillImageFormat, "available", property(lambda _: False))
    with pytest.raises(ConfigError, match=image_format.requirement):
        StillImageCodec(image_format)
    registry = CodecRegistry(spec for spec in BUILTINS if spec.name != image_format.value)
    with pytest.raises(ConfigError, match=image_format.requirement):
        registry.create(image_format.value)
    with pytest.raises(StreamError, match=image_format.requirement):
        registry.spec_for_id(image_format.codec_id)
    with pytest.raises(ConfigError) as caught:
        registry.create("jpg")
    assert "needs" not in str(caught.value)


def test_webp_body_is_27_bytes_shorter_than_the_file() -> None:
    if not StillImageFormat.WEBP.available:
        pytest.skip("no WebP in this Pillow")
    for quality in range(10, 90, 10):
        file = io.BytesIO()
        Pillow.fromarray(snippet(49, 113)).save(file, "WEBP", quality=quality, method=6)
        short = webp_body(file.getvalue(), (49, 113))
        assert webp_file(short, (49, 113)) == file.getvalue()
        assert len(file.getvalue()) - len(short) == 27
    with pytest.raises(ConfigError, match="one VP8 key frame"):
        webp_body(b"RIFF" + bytes(60), (80, 80))


def jpegxl_size_header(height_px: int, width_px: int) -> bytes:
    """Return the long form: 30-bit sides, no ratio, as in ISO/IEC 18181-1."""
    bits = 0 | 3 << 1 | (height_px - 1) << 3 | 0 << 33 | 3 << 36 | (width_px - 1) << 38
    return b"\xff\x0a" + bits.to_bytes(10, "little")


@given(height_px=st.integers(1, 1 << 29), width_px=st.integers(1, 1 << 29))
def test_long_form_of_a_jpeg_xl_size_is_parsed(height_px: int, width_px: int) -> None:
    assert jpegxl_size(jpegxl_size_header(height_px, width_px)) == (height_px, width_px)


def test_sizes_in_jpeg_xl_streams_are_parsed() -> None:
    names = golden_names(StillImageFormat.JPEGXL)
    assert len(names) == 3
    for name in names:
        stream = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
        header = StreamHeader.unpack(stream)
        assert jpegxl_size(body(stream)) == (header.height_px, header.width_px)


@pytest.mark.skipif(not StillImageFormat.JPEGXL.available, reason="no pillow-jxl-plugin")
def test_jpeg_xl_codestream_of_another_size_is_rejected_before_decoding() -> None:
    header = StreamHeader(0x05, 0, 80, 80).pack()
    with pytest.raises(StreamError, match=r"size: got \(536870912, 80\)"):
        StillImageCodec(StillImageFormat.JPEGXL).decode(header + jpegxl_size_header(1 << 29, 80) + bytes(40))


@pytest.mark.parametrize("data", [b"", b"\xff\x0a", b"\0" * 40, b"\0\0\0\x0cJXL \r\n\x87\n" + bytes(20)])
def test_data_other_than_a_bare_jpeg_xl_codestream_is_rejected(data: bytes) -> None:
    with pytest.raises(StreamError, match="signature"):
        jpegxl_size(data)


AVIF_SIZES = [(16, 16), (17, 33), (49, 113), (80, 80), (384, 384), (385, 384), (16, 512), (512, 16), (512, 512)]
WITH_AVIF = pytest.mark.skipif(not StillImageFormat.AVIF.available, reason="no AVIF in this Pillow")


def noise(height_px: int, width_px: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height_px, width_px), dtype=np.uint8)


def avif_of(image: np.ndarray, quality: int) -> bytes:
    file = io.BytesIO()
    Pillow.fromarray(image).save(file, "AVIF", quality=quality, subsampling="4:0:0", speed=4, max_threads=1)
    return file.getvalue()


@WITH_AVIF
@pytest.mark.parametrize("size", AVIF_SIZES)
def test_avif_file_is_rebuilt_exactly_from_a_body_271_bytes_shorter(size: tuple[int, int]) -> None:
    for quality in (0, 30, 90):
        file = avif_of(noise(*size), quality)
        frame = avif_body(file, size)
        assert avif_file(frame, size) == file
        assert len(file) - len(frame) == 271
        check_av1_frame(frame, size)


@WITH_AVIF
def test_small_avif_budgets_are_met() -> None:
    image = (noise(80, 80) // 16 + 100).astype(np.uint8)
    stream = StillImageCodec(StillImageFormat.AVIF).encode(image, 100)
    assert len(stream) <= 100
    assert StillImageCodec(StillImageFormat.AVIF).decode(stream).image.shape == (80, 80)


@WITH_AVIF
def test_complete_avif_files_of_earlier_releases_decode_the_same() -> None:
    codec = StillImageCodec(StillImageFormat.AVIF)
    for path in sorted(GOLDEN.glob("avif-*.hex")):
        if path.stem.endswith("picture"):
            continue
        stream = bytes.fromhex(path.read_text())
        header = StreamHeader.unpack(stream)
        shape = (header.height_px, header.width_px)
        short = stream[: header.size] + avif_body(stream[header.size :], shape)
        assert len(stream) - len(short) == 271
        assert np.array_equal(codec.decode(short).image, codec.decode(stream).image)


@WITH_AVIF
def test_avif_file_with_other_boxes_is_rejected() -> None:
    with pytest.raises(ConfigError, match="libavif"):
        avif_body(avif_of(noise(20, 20), 30), (20, 21))
    header = StreamHeader(0x06, 0, 80, 80).pack()
    with pytest.raises(StreamError, match="size"):
        StillImageCodec(StillImageFormat.AVIF).decode(header + avif_of(noise(80, 64), 30))


@WITH_AVIF
def test_only_one_av1_sequence_header_and_frame_of_the_right_size_is_accepted() -> None:
    good = avif_body(avif_of(noise(80, 80), 10), (80, 80))
    large = avif_body(avif_of(noise(512, 512), 0), (512, 512))
    sequence = large[: 2 + large[1]]
    for bad, field in (
        (large, "size"),
        (sequence + good, "units"),
        (good + sequence, "units"),
        (good + large, "units"),
        (good[:-1], "units"),
        (good + b"\0", "units"),
        (b"", "units"),
        (good[:1], "units"),
        (good[: 2 + good[1]], "units"),
        (b"\x12\0" + good, "units"),
    ):
        with pytest.raises(StreamError, match=field):
            check_av1_frame(bad, (80, 80))


@given(st.binary(max_size=40))
def test_any_av1_sequence_header_has_a_size_or_none(header: bytes) -> None:
    size = av1_sequence_size(header)
    assert size is None or (1 <= size[0] <= 65536 and 1 <= size[1] <= 65536)
