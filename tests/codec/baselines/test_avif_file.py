"""The AVIF file that a stream leaves out, and what is let through to the decoder."""

from __future__ import annotations

import io

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pillow

from sonarpost.codec.baselines.avif_file import avif_file, check_frame, frame_of, sequence_size
from sonarpost.codec.baselines.still_images import StillImageCodec, StillImageFormat
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import ConfigError, StreamError

GOLDEN = GOLDEN_FOLDER / "modern"
SIZES = [(16, 16), (17, 33), (49, 113), (80, 80), (384, 384), (385, 384), (16, 512), (512, 16), (512, 512)]
pytestmark = pytest.mark.skipif(not StillImageFormat.AVIF.available, reason="no AVIF in this Pillow")


def texture(height_px: int, width_px: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height_px, width_px), dtype=np.uint8)


def written(image: np.ndarray, quality: int) -> bytes:
    file = io.BytesIO()
    Pillow.fromarray(image).save(file, "AVIF", quality=quality, subsampling="4:0:0", speed=4, max_threads=1)
    return file.getvalue()


@pytest.mark.parametrize("size", SIZES)
def test_the_file_is_written_anew_to_the_byte_without_271(size: tuple[int, int]) -> None:
    for quality in (0, 30, 90):
        file = written(texture(*size), quality)
        frame = frame_of(file, size)
        assert avif_file(frame, size) == file
        assert len(file) - len(frame) == 271
        check_frame(frame, size)


def test_small_budgets_are_met() -> None:
    image = (texture(80, 80) // 16 + 100).astype(np.uint8)
    stream = StillImageCodec(StillImageFormat.AVIF).encode(image, 100)
    assert len(stream) <= 100
    assert StillImageCodec(StillImageFormat.AVIF).decode(stream).image.shape == (80, 80)


def test_whole_files_of_earlier_releases_decode_like_what_is_sent_now() -> None:
    codec = StillImageCodec(StillImageFormat.AVIF)
    for path in sorted(GOLDEN.glob("avif-*.hex")):
        if path.stem.endswith("picture"):
            continue
        stream = bytes.fromhex(path.read_text())
        header = StreamHeader.unpack(stream)
        shape = (header.height_px, header.width_px)
        short = stream[: header.size] + frame_of(stream[header.size :], shape)
        assert len(stream) - len(short) == 271
        assert np.array_equal(codec.decode(short).image, codec.decode(stream).image)


def test_another_file_is_refused() -> None:
    with pytest.raises(ConfigError, match="libavif"):
        frame_of(written(texture(20, 20), 30), (20, 21))
    header = StreamHeader(0x06, 0, 80, 80).pack()
    with pytest.raises(StreamError, match="size"):
        StillImageCodec(StillImageFormat.AVIF).decode(header + written(texture(80, 64), 30))


def test_only_one_sequence_header_and_frame_of_the_right_size_reaches_the_decoder() -> None:
    good = frame_of(written(texture(80, 80), 10), (80, 80))
    large = frame_of(written(texture(512, 512), 0), (512, 512))
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
            check_frame(bad, (80, 80))


@given(st.binary(max_size=40))
def test_any_sequence_header_has_a_size_or_none(header: bytes) -> None:
    size = sequence_size(header)
    assert size is None or (1 <= size[0] <= 65536 and 1 <= size[1] <= 65536)
