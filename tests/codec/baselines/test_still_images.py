"""JPEG XL, AVIF and WebP: budgets, golden streams, sizes, damage, absent libraries."""

from __future__ import annotations

import io

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import picture
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from sonarpost.codec.baselines import still_images as modern
from sonarpost.codec.baselines.still_images import StillImageCodec, StillImageFormat, jpegxl_size
from sonarpost.codec.interface import StreamHeader
from sonarpost.codec.quality import psnr_db
from sonarpost.codec.registry import BUILTINS, CodecRegistry, CodecResources
from sonarpost.errors import ConfigError, StreamError

GOLDEN = GOLDEN_FOLDER / "modern"


def with_library(wanted: StillImageFormat) -> object:
    absent = pytest.mark.skipif(not wanted.available, reason=f"{wanted.value} needs {wanted.needs}")
    return pytest.param(wanted, id=wanted.value, marks=absent)


EVERY = pytest.mark.parametrize("wanted", [with_library(wanted) for wanted in StillImageFormat])


def body(stream: bytes) -> bytes:
    return stream[StreamHeader.unpack(stream).size :]


def golden_names(wanted: StillImageFormat) -> list[str]:
    return sorted(path.stem for path in GOLDEN.glob(f"{wanted.value}-*.hex") if not path.stem.endswith("picture"))


@EVERY
def test_golden_streams_are_read_for_ever(wanted: StillImageFormat) -> None:
    names = golden_names(wanted)
    assert len(names) == 3
    for name in names:
        stream = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
        expected = np.frombuffer(bytes.fromhex((GOLDEN / f"{name}-picture.hex").read_text()), np.uint8)
        decoded = StillImageCodec(wanted).decode(stream)
        # WebP and AVIF decode to the bit, but are turned into grey by way of RGB; JPEG XL is floating point.
        assert np.abs(decoded.image.ravel().astype(int) - expected).max() <= 2
        assert not decoded.missing.any()


@EVERY
def test_the_best_that_fits_is_sent(wanted: StillImageFormat) -> None:
    codec, image = StillImageCodec(wanted), picture(80, 80)
    quality = []
    for budget in (1200, 2000, 3500):
        stream = codec.encode(image, budget)
        assert budget / 3 < len(stream) <= budget
        quality.append(psnr_db(image, codec.decode(stream).image))
    assert quality == sorted(quality)
    assert quality[-1] > quality[0] + 2


@EVERY
def test_a_budget_is_kept_to_the_byte(wanted: StillImageFormat) -> None:
    image = picture(48, 48)
    for quality in (20, 49, 60):
        length = len(StillImageCodec(wanted, quality).encode(image))
        assert len(StillImageCodec(wanted).encode(image, length)) <= length
        assert len(StillImageCodec(wanted).encode(image, length - 1)) < length


def test_no_quality_that_fits_is_much_better_than_the_one_sent() -> None:
    if not StillImageFormat.WEBP.available:
        pytest.skip("no WebP in this Pillow")
    image = picture(48, 64)
    streams = [StillImageCodec(StillImageFormat.WEBP, quality).encode(image) for quality in range(100)]
    reached = [psnr_db(image, StillImageCodec(StillImageFormat.WEBP).decode(stream).image) for stream in streams]
    for budget in (400, 700, 1500):
        best = max(db for db, stream in zip(reached, streams, strict=True) if len(stream) <= budget)
        sent = StillImageCodec(StillImageFormat.WEBP).encode(image, budget)
        assert psnr_db(image, StillImageCodec(StillImageFormat.WEBP).decode(sent).image) > best - 0.5


@EVERY
def test_a_budget_below_the_lowest_quality_is_refused(wanted: StillImageFormat) -> None:
    for budget in (0, 22, 60):
        with pytest.raises(StreamError, match=f"codec {wanted.value}: budget_bytes"):
            StillImageCodec(wanted).encode(picture(80, 80), budget)


@EVERY
def test_more_quality_is_a_nearer_picture(wanted: StillImageFormat) -> None:
    image = picture(64, 100)
    met = [
        psnr_db(image, StillImageCodec(wanted, quality).decode(StillImageCodec(wanted, quality).encode(image)).image)
        for quality in (5, 50, 99)
    ]
    assert met == sorted(met)
    assert met[-1] > 30


@EVERY
@pytest.mark.parametrize("quality", [-1, 100])
def test_a_quality_out_of_bounds_is_refused(wanted: StillImageFormat, quality: int) -> None:
    with pytest.raises(ConfigError, match="quality"):
        StillImageCodec(wanted, quality)


@EVERY
@pytest.mark.parametrize("size", [(16, 16), (17, 31), (16, 512), (511, 33)])
def test_every_size_comes_back(wanted: StillImageFormat, size: tuple[int, int]) -> None:
    image = picture(*size)
    decoded = StillImageCodec(wanted).decode(StillImageCodec(wanted).encode(image))
    assert psnr_db(image, decoded.image) > 18


@EVERY
def test_a_picture_of_another_size_is_refused(wanted: StillImageFormat) -> None:
    if wanted is StillImageFormat.WEBP:
        pytest.skip("its size is the stream header's and is not sent twice")
    stream = StillImageCodec(wanted).encode(picture(60, 80))
    with pytest.raises(StreamError, match="size"):
        StillImageCodec(wanted).decode(StreamHeader(wanted.codec_id, 0, 80, 60).pack() + body(stream))


@EVERY
def test_cut_or_damaged_is_a_picture_or_refused_and_nothing_is_printed(
    wanted: StillImageFormat, capfd: pytest.CaptureFixture[str]
) -> None:
    codec = StillImageCodec(wanted, 5)
    stream = codec.encode(picture(33, 47))
    refused = 0
    for at in range(5, len(stream), 3):
        damaged = bytearray(stream)
        damaged[at] ^= 0x5A
        for data in (bytes(damaged), stream[:at]):
            try:
                assert codec.decode(data).image.shape == (33, 47)
            except StreamError:
                refused += 1
    assert refused >= len(range(5, len(stream), 3)) / 2
    assert capfd.readouterr() == ("", "")


@EVERY
@given(junk=st.binary(max_size=200))
@settings(max_examples=40, deadline=None)
def test_any_body_is_a_picture_or_refused(wanted: StillImageFormat, junk: bytes) -> None:
    try:
        decoded = StillImageCodec(wanted).decode(StreamHeader(wanted.codec_id, 0, 48, 32).pack() + junk)
    except StreamError:
        return
    assert decoded.image.shape == (48, 32)


@EVERY
def test_a_gap_leaves_nothing_and_says_so(wanted: StillImageFormat) -> None:
    codec = StillImageCodec(wanted)
    stream = codec.encode(picture(48, 48))
    received = np.ones(len(body(stream)), np.bool_)
    assert np.array_equal(codec.decode(stream, received).image, codec.decode(stream).image)
    with pytest.raises(StreamError):  # damage is no gap
        codec.decode(stream[:-20], received[:-20])
    received[8:] = False
    decoded = codec.decode(stream, received)
    assert decoded.missing.all()
    assert not decoded.image.any()
    assert "nothing can be decoded" in decoded.notes[1]


@EVERY
def test_the_registry_has_it(wanted: StillImageFormat) -> None:
    codec = CodecRegistry(BUILTINS).create(wanted.value, CodecResources())
    assert (codec.name, codec.codec_id) == (wanted.value, wanted.codec_id)


@pytest.mark.parametrize("wanted", list(StillImageFormat), ids=lambda wanted: wanted.value)
def test_an_absent_library_is_named(wanted: StillImageFormat, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StillImageFormat, "available", property(lambda _: False))
    with pytest.raises(ConfigError, match=wanted.needs):
        StillImageCodec(wanted)
    registry = CodecRegistry(spec for spec in BUILTINS if spec.name != wanted.value)
    with pytest.raises(ConfigError, match=wanted.needs):
        registry.create(wanted.value, CodecResources())
    with pytest.raises(StreamError, match=wanted.needs):
        registry.spec_for_id(wanted.codec_id)
    with pytest.raises(ConfigError) as caught:
        registry.create("jpg", CodecResources())
    assert "needs" not in str(caught.value)


def test_a_webp_body_is_the_file_without_27_bytes() -> None:
    if not StillImageFormat.WEBP.available:
        pytest.skip("no WebP in this Pillow")
    for quality in range(10, 90, 10):
        file = io.BytesIO()
        Pillow.fromarray(picture(49, 113)).save(file, "WEBP", quality=quality, method=6)
        short = modern._key_frame(file.getvalue(), (49, 113))
        assert modern._webp_file(short, (49, 113)) == file.getvalue()
        assert len(file.getvalue()) - len(short) == 27
    with pytest.raises(ConfigError, match="one VP8 key frame"):
        modern._key_frame(b"RIFF" + bytes(60), (80, 80))


def size_header(height_px: int, width_px: int) -> bytes:
    """The long form: 30-bit sides, no ratio, as in ISO/IEC 18181-1."""
    bits = 0 | 3 << 1 | (height_px - 1) << 3 | 0 << 33 | 3 << 36 | (width_px - 1) << 38
    return b"\xff\x0a" + bits.to_bytes(10, "little")


@given(height_px=st.integers(1, 1 << 29), width_px=st.integers(1, 1 << 29))
def test_the_long_form_of_a_jpeg_xl_size_is_read(height_px: int, width_px: int) -> None:
    assert jpegxl_size(size_header(height_px, width_px)) == (height_px, width_px)


def test_the_sizes_in_jpeg_xl_streams_are_read() -> None:
    names = golden_names(StillImageFormat.JPEGXL)
    assert len(names) == 3
    for name in names:
        stream = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
        header = StreamHeader.unpack(stream)
        assert jpegxl_size(body(stream)) == (header.height_px, header.width_px)


@pytest.mark.skipif(not StillImageFormat.JPEGXL.available, reason="no pillow-jxl-plugin")
def test_a_jpeg_xl_codestream_of_another_size_is_refused_before_it_is_decoded() -> None:
    header = StreamHeader(0x05, 0, 80, 80).pack()
    with pytest.raises(StreamError, match=r"size: got \(536870912, 80\)"):
        StillImageCodec(StillImageFormat.JPEGXL).decode(header + size_header(1 << 29, 80) + bytes(40))


@pytest.mark.parametrize("data", [b"", b"\xff\x0a", b"\0" * 40, b"\0\0\0\x0cJXL \r\n\x87\n" + bytes(20)])
def test_what_is_no_bare_jpeg_xl_codestream_is_refused(data: bytes) -> None:
    with pytest.raises(StreamError, match="signature"):
        jpegxl_size(data)
