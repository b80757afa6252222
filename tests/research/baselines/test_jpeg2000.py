"""JPEG 2000: omitted headers, budgets, golden streams, damage, no output of the library."""

from __future__ import annotations

import io

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image as Pillow

from research.codecs.baselines import jpeg2000
from research.codecs.baselines.jpeg2000 import Jpeg2000Codec, codestream, main_header, packets_of
from sonarpost.codec.interface import StreamHeader
from sonarpost.codec.quality import psnr_db
from sonarpost.errors import ConfigError, StreamError

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


@pytest.mark.parametrize(("size", "decompositions"), [((64, 64), 3), ((80, 140), 4), ((80, 140), 5), ((512, 65), 6)])
def test_main_header_is_that_of_openjpeg(decompositions: int, size: tuple[int, int]) -> None:
    file = io.BytesIO()
    options = {"no_jp2": True, "irreversible": True, "num_resolutions": decompositions + 1}
    Pillow.fromarray(snippet(*size)).save(file, "JPEG2000", **options)
    stream = file.getvalue()
    header = main_header(*size, decompositions)
    assert stream.startswith(header)
    assert stream[len(header) : len(header) + 2] in (b"\xff\x64", b"\xff\x90")  # a comment or the tile


def test_raw_body_is_a_standard_file() -> None:
    stream = RAW.encode(snippet(80, 80), 400)
    with Pillow.open(io.BytesIO(body(stream))) as opened:
        assert (opened.format, opened.size, opened.mode) == ("JPEG2000", (80, 80), "L")
        assert np.array_equal(np.asarray(opened), RAW.decode(stream).image)
    assert b"\xff\x64" not in body(stream)[:120]  # no comment


def test_packets_codec_saves_the_headers() -> None:
    image = snippet(100, 128)
    image += 128 - int(image.mean())  # so that no shift helps
    raw, packets = RAW.encode(image), PACKETS.encode(image)
    decompositions, inside = packets_of(body(raw), 100, 128)
    assert body(packets)[1:] == inside
    assert len(raw) - len(packets) == len(main_header(100, 128, decompositions)) + 12 + 2 + 2 - 1
    assert len(raw) - len(packets) > 90


def test_dark_image_is_brightened_before_coding() -> None:
    dark = (snippet(80, 80) // 6).astype(np.uint8)
    stream = PACKETS.encode(dark, 40)
    assert 4 * ((body(stream)[0] & 0x3F) - 32) > 80
    decompositions = 3 + (body(stream)[0] >> 6)
    unshifted = jpeg2000._search(dark, decompositions, 40 - 3)
    assert unshifted is not None
    plain = PACKETS.decode(stream[:2] + bytes([(decompositions - 3) << 6 | 32]) + unshifted)
    assert psnr_db(dark, PACKETS.decode(stream).image) > psnr_db(dark, plain.image)


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


@BOTH
def test_budget_below_the_coarsest_quality_is_rejected(codec: Jpeg2000Codec) -> None:
    for budget in (0, 3, 6):
        with pytest.raises(StreamError, match="budget_bytes"):
            codec.encode(snippet(80, 80), budget)


def test_codestream_of_another_size_is_rejected_before_decoding() -> None:
    inside = codestream(512, 512, 5, b"\0" * 20)
    for header in (StreamHeader(0x02, 0, 80, 80), StreamHeader(0x02, 0, 17, 80)):
        with pytest.raises(StreamError, match="codestream"):
            RAW.decode(header.pack() + inside)
    huge = inside.replace((512).to_bytes(4, "big"), b"\x7f\xff\xff\xff")
    with pytest.raises(StreamError, match="codestream"):
        RAW.decode(StreamHeader(0x02, 0, 512, 512).pack() + huge)


def test_truncated_raw_codestream_is_rejected() -> None:
    stream = RAW.encode(snippet(33, 47), 200)
    for length in range(2, len(stream), 3):
        with pytest.raises(StreamError):
            RAW.decode(stream[:length])
    with pytest.raises(StreamError):
        RAW.decode(stream + b"\0")


def test_error_names_an_openjpeg_with_other_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jpeg2000, "_LOWEST_STEPS", {3: 1, 4: 1, 5: 1, 6: 1})
    with pytest.raises(ConfigError, match="OpenJPEG"):
        RAW.encode(snippet(80, 80))
