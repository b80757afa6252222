"""JPEG 2000: omitted headers, budgets, golden streams, damage, no output of the library."""

import io

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pillow

from research.codecs.baselines.jpeg2000 import Jpeg2000Codec, codestream, packets_of
from research.common.quality import psnr_db
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import StreamError

GOLDEN = GOLDEN_FOLDER / "jpeg2000"
RAW, PACKETS = Jpeg2000Codec(), Jpeg2000Codec(packets_only=True)
BOTH = pytest.mark.parametrize("codec", [RAW, PACKETS], ids=lambda codec: codec.name)


def body(stream: bytes) -> bytes:
    return stream[StreamHeader.unpack(stream).size :]


@pytest.mark.parametrize(
    "name", ["raw-80x80-300", "raw-49x113-588", "raw-17x31-None", "packets-80x80-64", "packets-49x113-588"]
)
def test_golden_streams_are_decoded(name: str) -> None:
    stream = bytes.fromhex((GOLDEN / f"{name}.hex").read_text())
    expected = np.frombuffer(bytes.fromhex((GOLDEN / f"{name}-image.hex").read_text()), np.uint8)
    decoded = (RAW if name.startswith("raw") else PACKETS).decode(stream)
    # OpenJPEG's inverse 9/7 is floating point: another build may round a sample to its neighbour.
    assert np.abs(decoded.image.ravel().astype(int) - expected).max() <= 1
    assert not decoded.missing.any()
    assert decoded.notes == ()


@given(
    size=st.tuples(st.integers(16, 512), st.integers(16, 512)),
    decompositions=st.integers(3, 6),
    packets=st.binary(max_size=50),
)
def test_packets_of_inverts_codestream(size: tuple[int, int], decompositions: int, packets: bytes) -> None:
    stream = codestream(*size, decompositions, packets)
    assert packets_of(stream, *size) == (decompositions, packets)
    with pytest.raises(StreamError):
        packets_of(stream, size[0], size[1] + 1)
    with pytest.raises(StreamError):
        packets_of(stream[:-1], *size)


def test_raw_body_is_a_standard_file() -> None:
    stream = RAW.encode(snippet(80, 80), 400)
    with Pillow.open(io.BytesIO(body(stream))) as opened:
        assert (opened.format, opened.size, opened.mode) == ("JPEG2000", (80, 80), "L")
        assert np.array_equal(np.asarray(opened), RAW.decode(stream).image)
    assert b"\xff\x64" not in body(stream)[:120]  # no comment


@BOTH
def test_budgets_are_met_and_quality_increases(codec: Jpeg2000Codec) -> None:
    for size in ((16, 16), (49, 113)):
        image = snippet(*size)
        quality = []
        for budget in (150, 220, 400, 3000):
            stream = codec.encode(image, budget)
            assert len(stream) <= budget
            quality.append(psnr_db(image, codec.decode(stream).image))
        assert quality == sorted(quality)


def test_codestream_of_another_size_is_rejected_before_decoding() -> None:
    inside = codestream(512, 512, 5, b"\0" * 20)
    for header in (StreamHeader(0x02, 0, 80, 80), StreamHeader(0x02, 0, 17, 80)):
        with pytest.raises(StreamError, match="codestream"):
            RAW.decode(header.pack() + inside)
    huge = inside.replace((512).to_bytes(4, "big"), b"\x7f\xff\xff\xff")
    with pytest.raises(StreamError, match="codestream"):
        RAW.decode(StreamHeader(0x02, 0, 512, 512).pack() + huge)
