"""What came after JPEG 2000: JPEG XL, AVIF and WebP through Pillow, to compare with.

Each is there where the installed Pillow offers it: WebP and AVIF in its usual wheels, JPEG XL with the plug-in
`pillow-jxl-plugin`. They are made for pictures of many kilobytes. With a budget, the best quality that fits is sent; on
textured snippets even the lowest takes some hundred bytes, and a smaller budget is refused.

The body of `jpegxl` is the codestream as the library writes it. Of `webp` it is the VP8 key frame less its start code
and size, which the decoder knows (RFC 6386, section 9.1); with the RIFF container that saves 27 bytes. Of `avif` it is
the AV1 sequence header and frame without the file around them, which saves 271 (`avif_file`); a body that is a whole
file, as earlier releases sent it, is read too.

Libraries make room for a picture when they read its size, so the size is compared with the stream header's first.
None of the three decodes in part: what is cut is refused.
"""

from __future__ import annotations

import importlib
import importlib.util
import io
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow
from PIL import features

from sonarpost.codec.baselines.avif_file import avif_file, check_frame, frame_of
from sonarpost.codec.interface import DecodedImage, Image, Mask, StreamHeader, check_image, received_body, to_uint8
from sonarpost.errors import ConfigError, StreamError

NATURAL_QUALITY = 30
MAX_QUALITY = 99  # 100 asks JPEG XL for lossless coding, by another route

_KEY_FRAME_TAG = 3  # bytes
_START_CODE = b"\x9d\x01\x2a"


class StillImageFormat(Enum):
    """A format, by its name in the registry."""

    JPEGXL = "jpegxl"
    AVIF = "avif"
    WEBP = "webp"

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return {"jpegxl": 0x05, "avif": 0x06, "webp": 0x07}[self.value]

    @property
    def needs(self) -> str:
        """What has to be installed, for people."""
        return "pillow-jxl-plugin" if self is StillImageFormat.JPEGXL else f"a Pillow built with {self.value}"

    @property
    def available(self) -> bool:
        """Whether the library is there."""
        if self is StillImageFormat.JPEGXL:
            return importlib.util.find_spec("pillow_jxl") is not None
        return bool(features.check(self.value))


@dataclass(frozen=True)
class StillImageCodec:
    """A format of a library. Satisfies `sonarpost.codec.interface.Codec`.

    Attributes:
        format: Which one.
        quality: The library's quality when no budget is given, 0..99.

    Raises:
        ConfigError: The library is not installed, or `quality` is out of bounds.
    """

    format: StillImageFormat
    quality: int = NATURAL_QUALITY

    def __post_init__(self) -> None:
        if not self.format.available:
            raise ConfigError(f"codec {self.name}", "library", "not installed", self.format.needs)
        if not 0 <= self.quality <= MAX_QUALITY:
            raise ConfigError(f"codec {self.name}", "quality", self.quality, f"0..{MAX_QUALITY}")

    @property
    def name(self) -> str:
        """Name in the registry."""
        return self.format.value

    @property
    def codec_id(self) -> int:
        """Number in the stream header."""
        return self.format.codec_id

    @property
    def model_hash(self) -> str:
        """Empty: there is no model."""
        return ""

    def encode(self, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], budget_bytes: int | None = None) -> bytes:
        """Return the stream.

        Args:
            image: Shape (16..512, 16..512), uint8 or uint16 (uint16 is mapped to 8 bits by `to_uint8`).
            budget_bytes: Most bytes of the whole stream; None for what `quality` takes.

        Raises:
            StreamError: Size or dtype is not supported, or no quality tried fits the budget.
        """
        check_image(image)
        grey = to_uint8(image)
        header = StreamHeader(self.codec_id, 0, grey.shape[0], grey.shape[1]).pack()
        if budget_bytes is None:
            return header + _encode(self.format, grey, self.quality)
        body = _search(self.format, grey, budget_bytes - len(header))
        if body is None:
            raise StreamError(f"codec {self.name}", "budget_bytes", budget_bytes, "more: not the lowest quality fits")
        return header + body

    def decode(self, stream: bytes, received: Mask | None = None) -> DecodedImage:
        """Rebuild the picture.

        Args:
            stream: Header and body.
            received: Shape (body bytes in `stream`,), False where a body byte did not arrive. If what precedes the
                first gap does not decode, the whole picture is black and missing.

        Raises:
            StreamError: The header is wrong, the stream is another codec's, or the body is cut, damaged, or a picture
                of another size.
        """
        header, body, notes = received_body(stream, received, self.codec_id, self.name)
        shape = (header.height_px, header.width_px)
        try:
            image = _decode(self.format, body, shape)
        except StreamError as error:
            if received is None or received.all():
                raise
            notes.append(f"nothing can be decoded: {error}")
            return DecodedImage(np.zeros(shape, np.uint8), np.ones(shape, np.bool_), tuple(notes))
        return DecodedImage(image, np.zeros(shape, np.bool_), tuple(notes))


def _search(wanted: StillImageFormat, grey: Image, limit_bytes: int) -> bytes | None:
    """Return the body with the least error among those tried that fit, or None.

    Halves the range of qualities. Neither length nor error follow the quality strictly, so the last that fits need not
    be the best; on average it is 0.01 dB below.
    """
    best, least = None, 0
    low, high = 0, MAX_QUALITY
    while low <= high:
        quality = (low + high) // 2
        body = _encode(wanted, grey, quality)
        if len(body) > limit_bytes:
            high = quality - 1
            continue
        low = quality + 1
        error = int(((_decode(wanted, body, grey.shape).astype(np.int64) - grey) ** 2).sum())
        if best is None or error < least:
            best, least = body, error
    return best


def _encode(wanted: StillImageFormat, grey: Image, quality: int) -> bytes:
    file, picture = io.BytesIO(), Pillow.fromarray(grey)
    match wanted:
        case StillImageFormat.WEBP:
            picture.save(file, "WEBP", quality=quality, method=6)
            return _key_frame(file.getvalue(), grey.shape)
        case StillImageFormat.AVIF:
            picture.save(file, "AVIF", quality=quality, subsampling="4:0:0", speed=4, max_threads=1)
            return frame_of(file.getvalue(), grey.shape)
        case StillImageFormat.JPEGXL:
            importlib.import_module("pillow_jxl")
            picture.save(file, "JXL", quality=quality, effort=7, num_threads=0)
    return file.getvalue()


def _decode(wanted: StillImageFormat, body: bytes, shape: tuple[int, ...]) -> Image:
    """Return the picture.

    Raises:
        StreamError: The library refuses it, or it has another size.
    """
    file = body
    if wanted is StillImageFormat.WEBP:
        file = _webp_file(body, shape)
    elif wanted is StillImageFormat.AVIF:
        file = _avif_file(body, shape)
    elif wanted is StillImageFormat.JPEGXL:
        importlib.import_module("pillow_jxl")
        _check_size(wanted, jpegxl_size(body), shape)
    try:
        with Pillow.open(
            io.BytesIO(file), formats=["JXL" if wanted is StillImageFormat.JPEGXL else wanted.name]
        ) as picture:
            _check_size(wanted, (picture.height, picture.width), shape)
            return np.array(picture.convert("L"), dtype=np.uint8)
    except StreamError:
        raise
    except Exception as error:  # the libraries raise many types on damaged data, and mean one thing
        raise StreamError(f"{wanted.value} body", "data", repr(error), "data that the library decodes") from error


def _check_size(wanted: StillImageFormat, met: tuple[int, int], shape: tuple[int, ...]) -> None:
    if met != shape:
        raise StreamError(f"{wanted.value} body", "size", met, f"{shape}, the stream header's")


def _vp8_size(shape: tuple[int, ...]) -> bytes:
    return shape[1].to_bytes(2, "little") + shape[0].to_bytes(2, "little")


def _key_frame(file: bytes, shape: tuple[int, ...]) -> bytes:
    """Return a WebP file's VP8 key frame without start code and size.

    Raises:
        ConfigError: This libwebp writes something else than one plain lossy frame.
    """
    frame = file[20 : 20 + int.from_bytes(file[16:20], "little")]
    known = _START_CODE + _vp8_size(shape)
    end = _KEY_FRAME_TAG + len(known)
    if file[:4] + file[8:16] != b"RIFFWEBPVP8 " or frame[_KEY_FRAME_TAG:end] != known:
        raise ConfigError("libwebp", "file", file[:40].hex(), "one VP8 key frame")
    return frame[:_KEY_FRAME_TAG] + frame[end:]


def _webp_file(body: bytes, shape: tuple[int, ...]) -> bytes:
    """Return the WebP file around what `_key_frame` leaves."""
    frame = body[:_KEY_FRAME_TAG] + _START_CODE + _vp8_size(shape) + body[_KEY_FRAME_TAG:]
    chunk = b"WEBPVP8 " + len(frame).to_bytes(4, "little") + frame
    return b"RIFF" + len(chunk).to_bytes(4, "little") + chunk


def _avif_file(body: bytes, shape: tuple[int, ...]) -> bytes:
    """Return the AVIF file around a body, or the body if it is one already.

    Raises:
        StreamError: It is neither, or a picture of another size.
    """
    frame = body
    if body[4:8] == b"ftyp":
        try:
            frame = frame_of(body, shape)
        except ConfigError as error:
            raise StreamError("avif body", "file or its size", body[:32], f"a grey still of {shape}") from error
    check_frame(frame, shape)
    return avif_file(frame, shape)


def jpegxl_size(codestream: bytes) -> tuple[int, int]:
    """Return height and width that a bare JPEG XL codestream begins with (ISO/IEC 18181-1, SizeHeader).

    Raises:
        StreamError: It is no bare codestream, or too short.
    """
    if len(codestream) < 12 or codestream[:2] != b"\xff\x0a":
        raise StreamError("jpegxl body", "signature", codestream[:12], "a JPEG XL codestream")
    bits = int.from_bytes(codestream[2:12], "little")

    def read(count: int) -> int:
        nonlocal bits
        value, bits = bits & ((1 << count) - 1), bits >> count
        return value

    small = read(1)

    def side() -> int:
        return 8 * (read(5) + 1) if small else read((9, 13, 18, 30)[read(2)]) + 1

    height = side()
    ratio = read(3)
    if ratio == 0:
        return height, side()
    over, under = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))[ratio - 1]
    return height, height * over // under
