"""Claims of coded images: what a record says about sizes costs the receiver a stated multiple of what was sent."""

import tracemalloc

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from builders.images import snippet
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import ValidationError

from sonarpost import wire
from sonarpost.archive.decoder import Decoder
from sonarpost.archive.image_files import SUFFIXES, write_image
from sonarpost.archive.image_parts import coded_image
from sonarpost.codec import interface
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import load
from sonarpost.errors import BadInputError
from sonarpost.messages import CodedImage, EncodedImage, ImagePart, ReceivedImage
from sonarpost.messages.image import MAX_SIDE_PX, MAX_STREAM_BYTES

CODEBOOK = GOLDEN_FOLDER / "vq" / "small.tiles"
DECODER = Decoder([str(CODEBOOK)])
TILES = CodecResources(load(CODEBOOK).tiles)
REGISTRY = default_registry()
CODECS = [name for name in REGISTRY.names() if name != "jpegxl"]  # the library is an optional extra
FILES_FACTOR, FILES_BYTES = 8, 4000
"""Files of an image of which no pixel arrived, for each byte that was sent, and in addition."""
MEMORY_BYTES = 128 * MAX_SIDE_PX * MAX_SIDE_PX
"""Limit of the memory that decoding takes, for any stream."""

sides = st.none() | st.integers(0, 5000)
headers = st.sampled_from(
    [
        interface.StreamHeader(codec.codec_id, interface.model_tag(codec.codec_id, codec.model_hash), *size).pack()
        for codec in (REGISTRY.create(name, TILES) for name in CODECS)
        for size in ((16, 16), (512, 512), (511, 509), (16, 512))
    ]
)


@st.composite
def parts(draw):
    """Return the encoded fields of a record as a vessel can forge them."""
    first = draw(st.just(b"") | headers) + draw(st.binary(max_size=60))
    length = draw(st.none() | st.integers(0, MAX_STREAM_BYTES))
    missing = draw(st.sampled_from([(), ((len(first), length or len(first) + 1),)]))
    fields = {"u": "uuv-1", "i": "00A7", "n": 1, "t": 1.7e9, "p": first, "z": length, "m": missing}
    return fields | {"h": draw(sides), "w": draw(sides)}


def cost(record, folder):
    """Decode and store a record; return its image, the bytes of its files and the peak of the memory."""
    DECODER.decode(record)  # compiles the codec, which is not measured
    tracemalloc.start()
    try:
        image = DECODER.decode(record)
        tiff = write_image(folder, image).tiff
        files_bytes = sum(tiff.with_suffix(suffix).stat().st_size for suffix in SUFFIXES)
        return image, files_bytes, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@given(fields=parts())
@example(fields={"u": "uuv-1", "i": "00A7", "n": 1, "t": 1.7e9, "h": 4096, "w": 4096})
@example(fields={"u": "uuv-1", "i": "00A7", "n": 1, "t": 1.7e9, "h": 512, "w": 512, "z": MAX_STREAM_BYTES})
@example(fields={"u": "uuv-1", "i": "00A7", "n": 1, "t": 1.7e9, "p": b'"2\xe0'})  # 512 px, all missing
def test_record_costs_at_most_a_multiple_of_its_bytes(fields, tmp_path_factory):
    try:
        part = ImagePart.model_validate(fields)
        image, files_bytes, memory_bytes = cost(coded_image(part, "vessel-1", "key"), tmp_path_factory.mktemp("out"))
    except (ValidationError, BadInputError):
        return
    assert max(image.pixels.height_px, image.pixels.width_px) <= MAX_SIDE_PX
    assert memory_bytes < MEMORY_BYTES
    if image.missing_fraction == 1.0:
        assert files_bytes <= FILES_BYTES + FILES_FACTOR * len(wire.encode(part))


@pytest.mark.parametrize("name", CODECS)
def test_codec_takes_no_more_memory_than_its_largest_image(name):
    codec = REGISTRY.create(name, TILES)
    stream = codec.encode(snippet(MAX_SIDE_PX, MAX_SIDE_PX))
    header = interface.StreamHeader.unpack(stream).size
    noise = np.random.default_rng(1).integers(0, 256, MAX_STREAM_BYTES - header, dtype=np.uint8).tobytes()
    codec.decode(stream)  # tables and models are loaded once
    for body in (b"", noise[:50], bytes(len(noise))):
        tracemalloc.start()
        try:
            codec.decode(stream[:header] + body)
        except BadInputError:
            pass
        finally:
            peak_bytes = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert peak_bytes < MEMORY_BYTES


def test_records_of_coded_images_have_the_limit_of_the_codecs():
    assert MAX_SIDE_PX == interface.MAX_SIDE_PX
    for record, names in (
        (EncodedImage, ("height_px", "width_px")),
        (ReceivedImage, ("height_px", "width_px")),
        (CodedImage, ("height_px", "width_px")),
        (ImagePart, ("h", "w")),
    ):
        for name in names:
            adapter = record.__pydantic_validator__
            with pytest.raises(ValidationError, match="less than or equal to 512"):
                adapter.validate_assignment(record.model_construct(), name, MAX_SIDE_PX + 1)
