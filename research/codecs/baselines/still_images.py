"""JPEG XL, AVIF and WebP through Pillow, for comparison.

A format is available if the installed Pillow supports it: WebP and AVIF in its usual wheels, JPEG XL with
`pillow-jxl-plugin`. These formats are made for images of many kilobytes. With a budget, the encoder sends the best
quality that fits. On textured snippets the lowest quality needs some hundred bytes, and a smaller budget is rejected.

The body omits everything that follows from the image size:

* `jpegxl`: the codestream as the library writes it.
* `webp`: the VP8 key frame without start code and size (RFC 6386, section 9.1). 27 bytes less than the file.
* `avif`: the AV1 sequence header and frame (AV1 specification, section 5.5). libavif writes 269 bytes of boxes before
  the first byte of AV1 (ISO/IEC 14496-12 and 23008-12, AVIF 1.1), then a temporal delimiter of 2 bytes. Only two
  lengths, the size and the level vary.

Libraries allocate memory for the size in the data, so the decoder first compares that size with the stream header. No
format decodes a truncated body.
"""

import importlib
import importlib.util
import io
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import ClassVar

import numpy as np
from PIL import Image as Pillow
from PIL import features

from research.codecs.baselines.jpeg2000 import decode_whole_body
from sonarpost.codec.interface import DecodedImage, Image, Mask, SnippetPixels, encoder_input
from sonarpost.errors import ConfigError, StreamError

DEFAULT_QUALITY = 30
MAX_QUALITY = 99  # 100 selects lossless JPEG XL

_VP8_TAG_BYTES = 3
_VP8_START_CODE = b"\x9d\x01\x2a"
_AV1_DELIMITER = b"\x12\x00"
_AV1_SEQUENCE_HEADER, _AV1_FRAME = 0x0A, 0x32  # OBU types 1 and 6, each with its length
_AV1_LEVEL_2_0_PIXELS = 147_456  # AV1 specification, annex A.3; level 2.1 is enough for 512 x 512


class StillImageFormat(Enum):
    """A format. The value is the name in the registry."""

    JPEGXL = "jpegxl"
    AVIF = "avif"
    WEBP = "webp"

    @property
    def codec_id(self) -> int:
        """Codec id in the stream header."""
        return {"jpegxl": 0x05, "avif": 0x06, "webp": 0x07}[self.value]

    @property
    def requirement(self) -> str:
        """Software to install for this format."""
        return "pillow-jxl-plugin" if self is StillImageFormat.JPEGXL else f"a Pillow built with {self.value}"

    @property
    def available(self) -> bool:
        """Whether that software is installed."""
        if self is StillImageFormat.JPEGXL:
            return importlib.util.find_spec("pillow_jxl") is not None
        return bool(features.check(self.value))


@dataclass(frozen=True)
class StillImageCodec:
    """Codec of one format. Implements `sonarpost.codec.Codec`.

    Attributes:
        format: The format.
        quality: Quality setting of the library without a budget, 0..99.

    Raises:
        ConfigError: The library is not installed, or `quality` is out of range.
    """

    format: StillImageFormat
    quality: int = DEFAULT_QUALITY
    model_hash: ClassVar[str] = ""

    def __post_init__(self) -> None:
        if not self.format.available:
            raise ConfigError(f"codec {self.name}", "library", "not installed", self.format.requirement)
        if not 0 <= self.quality <= MAX_QUALITY:
            raise ConfigError(f"codec {self.name}", "quality", self.quality, f"0..{MAX_QUALITY}")

    @property
    def name(self) -> str:
        """Name in the registry."""
        return self.format.value

    @property
    def codec_id(self) -> int:
        """Codec id in the stream header."""
        return self.format.codec_id

    def encode(self, image: SnippetPixels, budget_bytes: int | None = None) -> bytes:
        """Return the stream (see `Codec.encode`); without a budget, at `quality`."""
        grey, header = encoder_input(self, image)
        if budget_bytes is None:
            return header.pack() + _encode(self.format, grey, self.quality)
        body = _search_quality(self.format, grey, budget_bytes - header.size)
        if body is None:
            expected = "a larger budget: the lowest quality does not fit"
            raise StreamError(f"codec {self.name}", "budget_bytes", budget_bytes, expected)
        return header.pack() + body

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Reconstruct the image (see `decode_whole_body`)."""
        return decode_whole_body(self, stream, received, partial(_decode, self.format))


def _search_quality(image_format: StillImageFormat, grey: Image, limit_bytes: int) -> bytes | None:
    """Return the body with the smallest error among the tested ones of at most `limit_bytes`, or None.

    Binary search over the quality. Length and error are not strictly monotonic in it, so the last body that fits is not
    always the best; on average it is 0.01 dB below the best.
    """
    best, best_error = None, 0
    low, high = 0, MAX_QUALITY
    while low <= high:
        quality = (low + high) // 2
        body = _encode(image_format, grey, quality)
        if len(body) > limit_bytes:
            high = quality - 1
            continue
        low = quality + 1
        error = int(((_decode(image_format, body, grey.shape).astype(np.int64) - grey) ** 2).sum())
        if best is None or error < best_error:
            best, best_error = body, error
    return best


def _encode(image_format: StillImageFormat, grey: Image, quality: int) -> bytes:
    file, image = io.BytesIO(), Pillow.fromarray(grey)
    match image_format:
        case StillImageFormat.WEBP:
            image.save(file, "WEBP", quality=quality, method=6)
            return webp_body(file.getvalue(), grey.shape)
        case StillImageFormat.AVIF:
            image.save(file, "AVIF", quality=quality, subsampling="4:0:0", speed=4, max_threads=1)
            return avif_body(file.getvalue(), grey.shape)
        case StillImageFormat.JPEGXL:
            importlib.import_module("pillow_jxl")
            image.save(file, "JXL", quality=quality, effort=7, num_threads=0)
    return file.getvalue()


def _decode(image_format: StillImageFormat, body: bytes, shape: tuple[int, ...]) -> Image:
    """Return the image of a body.

    Raises:
        StreamError: The library rejects the body, or the body has another size.
    """
    match image_format:
        case StillImageFormat.WEBP:
            file = webp_file(body, shape)
        case StillImageFormat.AVIF:
            check_av1_frame(body, shape)
            file = avif_file(body, shape)
        case StillImageFormat.JPEGXL:
            importlib.import_module("pillow_jxl")
            _check_size(image_format, jpegxl_size(body), shape)
            file = body
    pillow_name = "JXL" if image_format is StillImageFormat.JPEGXL else image_format.name
    try:
        with Pillow.open(io.BytesIO(file), formats=[pillow_name]) as opened:
            _check_size(image_format, (opened.height, opened.width), shape)
            return np.array(opened.convert("L"), dtype=np.uint8)
    except StreamError:
        raise
    except Exception as error:  # the libraries raise many types on damaged data
        raise StreamError(f"{image_format.value} body", "data", repr(error), "data that the library decodes") from error


def _check_size(image_format: StillImageFormat, actual: tuple[int, int], shape: tuple[int, ...]) -> None:
    if actual != shape:
        raise StreamError(f"{image_format.value} body", "size", actual, f"{shape}, the stream header's")


def webp_body(file: bytes, shape: tuple[int, ...]) -> bytes:
    """Return the VP8 key frame of a WebP file without start code and size.

    Raises:
        ConfigError: This libwebp writes something other than one plain lossy frame.
    """
    frame = file[20 : 20 + int.from_bytes(file[16:20], "little")]
    removed = _VP8_START_CODE + _vp8_size(shape)
    end = _VP8_TAG_BYTES + len(removed)
    if file[:4] + file[8:16] != b"RIFFWEBPVP8 " or frame[_VP8_TAG_BYTES:end] != removed:
        raise ConfigError("libwebp", "file", file[:40].hex(), "one VP8 key frame")
    return frame[:_VP8_TAG_BYTES] + frame[end:]


def webp_file(body: bytes, shape: tuple[int, ...]) -> bytes:
    """Return the WebP file of a body. The inverse of `webp_body`."""
    frame = body[:_VP8_TAG_BYTES] + _VP8_START_CODE + _vp8_size(shape) + body[_VP8_TAG_BYTES:]
    chunk = b"WEBPVP8 " + len(frame).to_bytes(4, "little") + frame
    return b"RIFF" + len(chunk).to_bytes(4, "little") + chunk


def _vp8_size(shape: tuple[int, ...]) -> bytes:
    return shape[1].to_bytes(2, "little") + shape[0].to_bytes(2, "little")


def avif_body(file: bytes, shape: tuple[int, ...]) -> bytes:
    """Return the AV1 sequence header and frame of an AVIF file. The inverse of `avif_file`.

    Raises:
        ConfigError: This libavif writes other boxes.
    """
    frame = file[len(avif_file(b"", shape)) :]
    if file != avif_file(frame, shape):
        raise ConfigError("libavif", "file", file[:300].hex(), "the boxes of version 1, around one grey AV1 frame")
    return frame


def avif_file(frame: bytes, shape: tuple[int, ...]) -> bytes:
    """Return the AVIF file around a sequence header and frame."""
    payload = _AV1_DELIMITER + frame
    start = _box(b"ftyp", b"avif", bytes(4), b"avifmif1miaf")
    size = shape[1].to_bytes(4, "big") + shape[0].to_bytes(4, "big")
    level = int(shape[0] * shape[1] > _AV1_LEVEL_2_0_PIXELS)
    properties = _box(
        b"ipco",
        _box(b"ispe", bytes(4), size),
        _box(b"pixi", bytes(4), b"\x01\x08"),  # one channel of 8 bits
        _box(b"av1C", bytes([0x81, level, 0x1C, 0])),  # monochrome
        _box(b"colr", b"nclx\x00\x01\x00\x0d\x00\x06\x80"),  # BT.709, sRGB, BT.601, full range
    )
    associations = _box(b"ipma", bytes(4), b"\0\0\0\1\0\1\4\1\2\x83\4")
    boxes = (
        _box(b"hdlr", bytes(8), b"pict", bytes(13)),
        _box(b"pitm", bytes(4), b"\0\1"),
        _box(b"iloc", bytes(4), b"\x44\0\0\1\0\1\0\0\0\1", (269).to_bytes(4, "big"), len(payload).to_bytes(4, "big")),
        _box(b"iinf", bytes(4), b"\0\1", _box(b"infe", b"\2\0\0\0\0\1\0\0av01Color\0")),
        _box(b"iprp", properties, associations),
    )
    return start + _box(b"meta", bytes(4), *boxes) + _box(b"mdat", payload)


def _box(name: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return (8 + len(content)).to_bytes(4, "big") + name + content


def check_av1_frame(frame: bytes, shape: tuple[int, ...]) -> None:
    """Check that a body is one sequence header of a still picture of this size and one frame.

    The decoder allocates memory for the size in the sequence header. In the reduced form of still pictures the frame
    cannot have another size.

    Raises:
        StreamError: The body is something else.
    """
    expected = f"an AV1 sequence header and frame of a still picture of {shape[1]} × {shape[0]} px"
    length = frame[1] if len(frame) > 1 else 0
    header, rest = frame[2 : 2 + length], frame[2 + length :]
    # The length of the frame: 7 bits a byte, least significant first, at most 3 bytes.
    last = next((place for place in range(1, min(4, len(rest))) if not rest[place] & 0x80), 0)
    frame_bytes = sum((rest[place] & 0x7F) << 7 * (place - 1) for place in range(1, last + 1))
    if not last or frame[0] != _AV1_SEQUENCE_HEADER or rest[0] != _AV1_FRAME or frame_bytes != len(rest) - last - 1:
        raise StreamError("avif body", "units", frame[:16], expected)
    size = av1_sequence_size(header)
    if size != shape:
        raise StreamError("avif body", "size", size, f"{shape}, the stream header's")


def av1_sequence_size(header: bytes) -> tuple[int, int] | None:
    """Return height and width of a sequence header in the reduced form of still pictures, or None for other headers."""
    if len(header) < 7 or (header[0] >> 3) & 3 != 3:  # still_picture and reduced_still_picture_header
        return None
    bits = int.from_bytes(header[:8].ljust(8, b"\0"), "big")
    left = 64 - 10  # after the profile, the two flags and the level

    def read(count: int) -> int:
        nonlocal left
        left -= count
        return bits >> left & ((1 << count) - 1)

    width_bits, height_bits = read(4) + 1, read(4) + 1
    width_px, height_px = read(width_bits) + 1, read(height_bits) + 1
    return height_px, width_px


def jpegxl_size(codestream: bytes) -> tuple[int, int]:
    """Return height and width of a bare JPEG XL codestream (ISO/IEC 18181-1, SizeHeader).

    Raises:
        StreamError: The data is not a bare codestream, or is too short.
    """
    if len(codestream) < 12 or codestream[:2] != b"\xff\x0a":
        raise StreamError("jpegxl body", "signature", codestream[:12], "a JPEG XL codestream")
    bits = int.from_bytes(codestream[2:12], "little")

    def read(count: int) -> int:
        nonlocal bits
        value, bits = bits & ((1 << count) - 1), bits >> count
        return value

    is_small = read(1)

    def read_side() -> int:
        return 8 * (read(5) + 1) if is_small else read((9, 13, 18, 30)[read(2)]) + 1

    height_px = read_side()
    ratio = read(3)
    if ratio == 0:
        return height_px, read_side()
    numerator, denominator = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))[ratio - 1]
    return height_px, height_px * numerator // denominator
