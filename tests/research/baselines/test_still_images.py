"""JPEG XL, AVIF and WebP: budgets, golden streams, omitted headers, sizes, damage, missing libraries."""

import io

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet
from PIL import Image as Pillow

from research.codecs.baselines import comparison_registry, still_images
from research.codecs.baselines.jpeg2000 import Jpeg2000Codec
from research.codecs.baselines.still_images import StillImageCodec, StillImageFormat, avif_body, check_av1_frame
from research.common.quality import psnr_db
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import ConfigError, StreamError

GOLDEN = GOLDEN_FOLDER / "modern"


WEBP, AVIF, JPEGXL = StillImageFormat.WEBP, StillImageFormat.AVIF, StillImageFormat.JPEGXL


def parameter(image_format: StillImageFormat) -> object:
    needs = f"{image_format.value} needs {image_format.requirement}"
    marks = [pytest.mark.skipif(not image_format.available, reason=needs)]
    # The library of JPEG XL is an optional extra.
    return pytest.param(
        image_format, id=image_format.value, marks=marks + [pytest.mark.system] * (image_format is JPEGXL)
    )


EACH_FORMAT = pytest.mark.parametrize("image_format", [parameter(image_format) for image_format in StillImageFormat])


def body(stream: bytes) -> bytes:
    return stream[StreamHeader.unpack(stream).size :]


def golden_names(image_format: StillImageFormat) -> list[str]:
    return sorted(path.stem for path in GOLDEN.glob(f"{image_format.value}-*.hex") if not path.stem.endswith("image"))


@EACH_FORMAT
def test_golden_streams_are_decoded(image_format: StillImageFormat) -> None:
    names = golden_names(image_format)
    assert len(names) == 3
    for name in names:
        stream = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
        expected = np.frombuffer(bytes.fromhex((GOLDEN / f"{name}-image.hex").read_text()), np.uint8)
        decoded = StillImageCodec(image_format).decode(stream)
        # WebP and AVIF are exact but converted to grey through RGB; JPEG XL is floating point.
        assert np.abs(decoded.image.ravel().astype(int) - expected).max() <= 2
        assert not decoded.missing.any()


@EACH_FORMAT
def test_best_quality_within_the_budget_is_sent(image_format: StillImageFormat) -> None:
    codec, image = StillImageCodec(image_format), snippet(64, 64)
    quality = []
    for budget in (800, 1300, 2300):
        stream = codec.encode(image, budget)
        assert budget / 3 < len(stream) <= budget
        quality.append(psnr_db(image, codec.decode(stream).image))
    assert quality == sorted(quality)
    assert quality[-1] > quality[0] + 2


@pytest.mark.parametrize("image_format", [parameter(AVIF), parameter(JPEGXL)])
def test_body_of_another_size_is_rejected(image_format: StillImageFormat) -> None:
    stream = StillImageCodec(image_format).encode(snippet(60, 80))
    with pytest.raises(StreamError, match="size"):
        StillImageCodec(image_format).decode(StreamHeader(image_format.codec_id, 0, 80, 60).pack() + body(stream))


JPEG2000 = [Jpeg2000Codec(), Jpeg2000Codec(packets_only=True)]
EACH_CODEC = pytest.mark.parametrize(
    "make", [*(parameter(each) for each in StillImageFormat), *(pytest.param(c, id=c.name) for c in JPEG2000)]
)


@EACH_CODEC
def test_damaged_body_decodes_or_is_rejected_without_output(make, capfd: pytest.CaptureFixture[str]) -> None:
    codec = StillImageCodec(make, 5) if isinstance(make, StillImageFormat) else make
    stream = codec.encode(snippet(33, 47), 1000)
    rejected, places = 0, range(5, len(stream), 7)
    for at in places:
        damaged = bytearray(stream)
        damaged[at] ^= 0x5A
        for data in (bytes(damaged), stream[:at]):
            try:
                assert codec.decode(data).image.shape == (33, 47)
            except StreamError:
                rejected += 1
    assert rejected >= len(places) / 4
    assert capfd.readouterr() == ("", "")


@EACH_CODEC
def test_gap_makes_all_pixels_missing(make) -> None:
    codec = StillImageCodec(make) if isinstance(make, StillImageFormat) else make
    stream = codec.encode(snippet(80, 80), 400) if codec is make else codec.encode(snippet(32, 32))
    received = np.ones(len(body(stream)), np.bool_)
    assert np.array_equal(codec.decode(stream, received).image, codec.decode(stream).image)
    with pytest.raises(StreamError):  # damage is not a gap
        codec.decode(stream[:-20], received[:-20])
    received[8:] = False
    decoded = codec.decode(stream, received)
    assert decoded.missing.all()
    assert not decoded.image.any()
    assert "did not arrive" in decoded.notes[0]
    assert "nothing can be decoded" in decoded.notes[1]


@pytest.mark.parametrize("image_format", list(StillImageFormat), ids=lambda image_format: image_format.value)
def test_error_names_the_missing_library(image_format: StillImageFormat, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StillImageFormat, "available", property(lambda _: False))
    with pytest.raises(ConfigError, match=image_format.requirement):
        StillImageCodec(image_format)
    with pytest.raises(ConfigError, match=image_format.requirement):
        comparison_registry().create(image_format.value)


@pytest.mark.skipif(not WEBP.available, reason="no WebP in this Pillow")
def test_webp_body_is_27_bytes_shorter_than_the_file() -> None:
    for quality in range(10, 90, 20):
        file = io.BytesIO()
        Pillow.fromarray(snippet(49, 113)).save(file, "WEBP", quality=quality, method=6)
        short = still_images.webp_body(file.getvalue(), (49, 113))
        assert still_images.webp_file(short, (49, 113)) == file.getvalue()
        assert len(file.getvalue()) - len(short) == 27
    with pytest.raises(ConfigError, match="one VP8 key frame"):
        still_images.webp_body(b"RIFF" + bytes(60), (80, 80))


def jpegxl_size_header(height_px: int, width_px: int) -> bytes:
    """Return the long form: 30-bit sides, no ratio, as in ISO/IEC 18181-1."""
    bits = 0 | 3 << 1 | (height_px - 1) << 3 | 0 << 33 | 3 << 36 | (width_px - 1) << 38
    return b"\xff\x0a" + bits.to_bytes(10, "little")


def test_sizes_in_jpeg_xl_streams_are_parsed() -> None:
    names = golden_names(JPEGXL)
    assert len(names) == 3
    for name in names:
        stream = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
        header = StreamHeader.unpack(stream)
        assert still_images.jpegxl_size(body(stream)) == (header.height_px, header.width_px)


@pytest.mark.system
@pytest.mark.skipif(not JPEGXL.available, reason="no pillow-jxl-plugin")
def test_jpeg_xl_codestream_of_another_size_is_rejected_before_decoding() -> None:
    header = StreamHeader(0x05, 0, 80, 80).pack()
    with pytest.raises(StreamError, match=r"size: got \(536870912, 80\)"):
        StillImageCodec(JPEGXL).decode(header + jpegxl_size_header(1 << 29, 80) + bytes(40))


WITH_AVIF = pytest.mark.skipif(not AVIF.available, reason="no AVIF in this Pillow")


def noise(height_px: int, width_px: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height_px, width_px), dtype=np.uint8)


def avif_of(image: np.ndarray, quality: int) -> bytes:
    file = io.BytesIO()
    Pillow.fromarray(image).save(file, "AVIF", quality=quality, subsampling="4:0:0", speed=4, max_threads=1)
    return file.getvalue()


LARGE = [pytest.param(size, marks=pytest.mark.system) for size in ((384, 384), (385, 384), (512, 512))]


@WITH_AVIF
@pytest.mark.parametrize("size", [(16, 16), (17, 33), (49, 113), (16, 512), (512, 16), *LARGE])
def test_avif_file_is_rebuilt_exactly_from_a_body_271_bytes_shorter(size: tuple[int, int]) -> None:
    for quality in (0, 30, 90):
        file = avif_of(noise(*size), quality)
        frame = avif_body(file, size)
        assert still_images.avif_file(frame, size) == file
        assert len(file) - len(frame) == 271
        check_av1_frame(frame, size)


@WITH_AVIF
def test_avif_file_with_other_boxes_and_a_body_that_is_a_file_are_rejected() -> None:
    with pytest.raises(ConfigError, match="libavif"):
        avif_body(avif_of(noise(20, 20), 30), (20, 21))
    header = StreamHeader(0x06, 0, 80, 80).pack()
    with pytest.raises(StreamError, match="units"):
        StillImageCodec(AVIF).decode(header + avif_of(noise(80, 80), 30))


@WITH_AVIF
def test_only_one_av1_sequence_header_and_frame_of_the_right_size_is_accepted() -> None:
    good = avif_body(avif_of(noise(80, 80), 10), (80, 80))
    large = avif_body(avif_of(noise(200, 200), 0), (200, 200))
    sequence = large[: 2 + large[1]]
    with pytest.raises(StreamError, match="size"):
        check_av1_frame(large, (80, 80))
    several = [sequence + good, good + sequence, good + large, good + b"\0", b"\x12\0" + good]
    for bad in (*several, good[:-1], b"", good[:1], good[: 2 + good[1]]):
        with pytest.raises(StreamError, match="units"):
            check_av1_frame(bad, (80, 80))
