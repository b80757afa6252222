"""The `paper` acoustic wire format: half-image frames and contact frames, each decodable alone.

As in Fig. 6 and section III-D of the paper, a message starts with one character for top or bottom half and four
characters for the image. The paper's format assumes one half per message. Here an offset, the body length and the
stream header (six to eleven bytes) allow several frames per half, and give each half its place if the other is lost.
docs/specifications/acoustic-paper.md is the specification.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Literal

from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX, StreamHeader, tag_length
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.frames.contact_record import RECORD_SIZE, ContactSummary
from sonarpost.link.frames.v1.frame import checksum

HalfName = Literal["top", "bottom"]

HALF_PREFIX_SIZE = 9
"""Bytes of a half frame before the stream header."""
MAX_HALF_HEADER_SIZE = HALF_PREFIX_SIZE + StreamHeader.MAX_SIZE
CONTACT_FRAME_SIZE = 1 + 4 + RECORD_SIZE + 2
IMAGE_ID_COUNT = 36**4

_ID_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_ID_PATTERN = re.compile(r"[0-9A-Z]{4}")
_TYPE_OF_HALF: dict[HalfName, bytes] = {"top": b"T", "bottom": b"B"}
_CONTACT_TYPE = b"C"


def format_image_id(counter: int) -> str:
    """Return the image identifier of a counter: four base-36 digits, modulo 36**4."""
    number = counter % IMAGE_ID_COUNT
    digits = []
    for _ in range(4):
        number, digit = divmod(number, 36)
        digits.append(_ID_DIGITS[digit])
    return "".join(reversed(digits))


def is_image_id(text: str) -> bool:
    """Return whether `text` is an image identifier, four characters 0-9A-Z."""
    return _ID_PATTERN.fullmatch(text) is not None


def half_bounds(body_length: int, half: HalfName) -> tuple[int, int]:
    """Return the byte range [start, stop) of the body that `half` covers; the top half has the odd byte."""
    middle = (body_length + 1) // 2
    return (0, middle) if half == "top" else (middle, body_length)


@dataclass(frozen=True, slots=True)
class HalfFrame:
    """A piece of the top or bottom half of an encoded image.

    Attributes:
        half: "top" or "bottom".
        image_id: Four characters 0-9A-Z.
        offset: Position of the first payload byte in the whole body, within the half; the start of an empty half.
        body_length: Length of the whole body.
        header: The header of the stream, the same in every frame of the image.
        payload: Bytes of the body, not beyond the end of the half; can be empty.

    Raises:
        FrameError: A field is out of range.
    """

    half: HalfName
    image_id: str
    offset: int
    body_length: int
    header: StreamHeader
    payload: bytes

    def __post_init__(self) -> None:
        _check_image_id("half frame", self.image_id)
        _check_stream_header(self.header)
        if not 0 <= self.body_length <= 0xFFFF:
            raise FrameError("half frame", "body_length", self.body_length, "0..65535")
        start, stop = half_bounds(self.body_length, self.half)
        if not (start <= self.offset < stop or self.offset == start == stop):
            raise FrameError("half frame", "offset", self.offset, f"{start}..{max(start, stop - 1)} ({self.half} half)")
        if self.offset + len(self.payload) > stop:
            raise FrameError(
                "half frame", "payload", self.payload, f"at most {stop - self.offset} bytes to the half's end"
            )

    @property
    def stop(self) -> int:
        """Position just after the last payload byte in the whole body."""
        return self.offset + len(self.payload)

    def pack(self) -> bytes:
        """Return the frame without padding."""
        head = _TYPE_OF_HALF[self.half] + self.image_id.encode("ascii")
        return head + struct.pack(">HH", self.offset, self.body_length) + self.header.pack() + self.payload


@dataclass(frozen=True, slots=True)
class ContactFrame:
    """The contact record of an image.

    Attributes:
        image_id: Four characters 0-9A-Z.
        contact: The record.

    Raises:
        FrameError: The identifier is not four characters 0-9A-Z.
    """

    image_id: str
    contact: ContactSummary

    def __post_init__(self) -> None:
        _check_image_id("contact frame", self.image_id)

    def pack(self) -> bytes:
        """Return the 32 bytes, checksum included."""
        body = _CONTACT_TYPE + self.image_id.encode("ascii") + self.contact.pack()
        return body + struct.pack(">H", checksum(body))


def parse_frame(data: bytes, where: str = "acoustic frame") -> HalfFrame | ContactFrame:
    """Parse a frame as the modem delivered it.

    Bytes after the end of the half (or after the 32 bytes of a contact frame) are padding. A frame that was cut keeps
    the bytes that it has.

    Args:
        data: The frame.
        where: Name of the frame in errors.

    Raises:
        FrameError: Unknown type, too short, a field out of range, or a contact frame with a wrong checksum.
    """
    kind = data[:1]
    try:
        if kind == _CONTACT_TYPE:
            return _parse_contact(data)
        for half, letter in _TYPE_OF_HALF.items():
            if kind == letter:
                return _parse_half(half, data)
    except BadInputError as error:
        raise FrameError(where, error.field, error.value, error.expected) from error
    raise FrameError(where, "type", kind, "T, B or C")


def _parse_half(half: HalfName, data: bytes) -> HalfFrame:
    if len(data) < HALF_PREFIX_SIZE:
        raise FrameError("half frame", "length", len(data), f"at least {HALF_PREFIX_SIZE} bytes and a stream header")
    offset, body_length = struct.unpack_from(">HH", data, 5)
    header = StreamHeader.unpack(data[HALF_PREFIX_SIZE:])
    payload = data[HALF_PREFIX_SIZE + header.size :]
    length = max(0, half_bounds(body_length, half)[1] - offset)
    return HalfFrame(half, _parse_image_id(data), offset, body_length, header, payload[:length])


def _parse_contact(data: bytes) -> ContactFrame:
    if len(data) < CONTACT_FRAME_SIZE:
        raise FrameError("contact frame", "length", len(data), f"at least {CONTACT_FRAME_SIZE} bytes")
    body, (sent,) = data[: CONTACT_FRAME_SIZE - 2], struct.unpack_from(">H", data, CONTACT_FRAME_SIZE - 2)
    computed = checksum(body)
    if sent != computed:
        raise FrameError("contact frame", "checksum", f"0x{sent:04X}", f"0x{computed:04X}")
    return ContactFrame(_parse_image_id(data), ContactSummary.unpack(body[5:]))


def _parse_image_id(data: bytes) -> str:
    return data[1:5].decode("latin-1")


def _check_image_id(where: str, image_id: str) -> None:
    if not is_image_id(image_id):
        raise FrameError(where, "image identifier", image_id, "four characters 0-9A-Z")


def _check_stream_header(header: StreamHeader) -> None:
    limits = (
        ("codec_id", 0, 0xFF),
        ("model_tag", 0, (1 << 8 * tag_length(header.codec_id)) - 1),
        ("height_px", MIN_SIDE_PX, MAX_SIDE_PX),
        ("width_px", MIN_SIDE_PX, MAX_SIDE_PX),
    )
    for name, low, high in limits:
        value = getattr(header, name)
        if not low <= value <= high:
            raise FrameError("half frame", f"stream header {name}", value, f"{low}..{high}")
