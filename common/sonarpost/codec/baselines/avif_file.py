"""The AVIF file around one still grey AV1 frame, which follows from the picture's size.

libavif writes 269 bytes of boxes (ISO/IEC 14496-12 and 23008-12, AVIF 1.1) before the first byte of AV1. For the
pictures of this package all of them are known but two lengths, the size and the level, so a stream leaves them out,
and the temporal delimiter behind them: 271 bytes.

What is left is a sequence header and a frame (AV1 specification, section 5.5). The decoder makes room for what the
sequence header says, so it must be a still picture in the reduced form, in which no frame can have another size, and
there must be one of it.
"""

from __future__ import annotations

from sonarpost.errors import ConfigError, StreamError

_DELIMITER = b"\x12\x00"
_SEQUENCE_HEADER, _FRAME = 0x0A, 0x32  # OBU types 1 and 6, each with its length
_LEVEL_2_0_PIXELS = 147_456  # AV1 specification, annex A.3; level 2.1, the next, holds 512 x 512


def avif_file(frame: bytes, shape: tuple[int, ...]) -> bytes:
    """Return the whole file around sequence header and frame.

    Args:
        frame: What `frame_of` leaves.
        shape: (height_px, width_px).
    """
    payload = _DELIMITER + frame
    head = _box(b"ftyp", b"avif", bytes(4), b"avifmif1miaf")
    size = shape[1].to_bytes(4, "big") + shape[0].to_bytes(4, "big")
    level = int(shape[0] * shape[1] > _LEVEL_2_0_PIXELS)
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
    return head + _box(b"meta", bytes(4), *boxes) + _box(b"mdat", payload)


def frame_of(file: bytes, shape: tuple[int, ...]) -> bytes:
    """Return sequence header and frame of a file; the inverse of `avif_file`.

    Raises:
        ConfigError: This libavif writes something else.
    """
    start = len(avif_file(b"", shape))
    frame = file[start:]
    if file != avif_file(frame, shape):
        raise ConfigError("libavif", "file", file[:300].hex(), "the boxes of version 1, around one grey AV1 frame")
    return frame


def check_frame(frame: bytes, shape: tuple[int, ...]) -> None:
    """Look whether a body is one sequence header of a still picture of this size, and one frame.

    Raises:
        StreamError: It is not.
    """
    expected = f"an AV1 sequence header and frame of a still picture of {shape[0]} x {shape[1]} px"
    length = frame[1] if len(frame) > 1 else 0
    header, rest = frame[2 : 2 + length], frame[2 + length :]
    # The length of a frame: seven bits a byte, the lowest first; no body takes more than three.
    place = next((at for at in range(1, min(4, len(rest))) if not rest[at] & 0x80), 0)
    promised = sum((rest[at] & 0x7F) << 7 * (at - 1) for at in range(1, place + 1))
    if not place or frame[0] != _SEQUENCE_HEADER or rest[0] != _FRAME or promised != len(rest) - place - 1:
        raise StreamError("avif body", "units", frame[:16], expected)
    if sequence_size(header) != shape:
        raise StreamError("avif body", "size", sequence_size(header), f"{shape}, the stream header's")


def sequence_size(header: bytes) -> tuple[int, int] | None:
    """Return height and width of a sequence header in the reduced form of still pictures; None if it is no such."""
    if len(header) < 7 or (header[0] >> 3) & 3 != 3:  # still_picture and reduced_still_picture_header
        return None
    bits = int.from_bytes(header[:8].ljust(8, b"\0"), "big")
    left = 64 - 10  # behind profile, the two flags and the level

    def read(count: int) -> int:
        nonlocal left
        left -= count
        return bits >> left & ((1 << count) - 1)

    width_bits, height_bits = read(4) + 1, read(4) + 1
    width_px, height_px = read(width_bits) + 1, read(height_bits) + 1
    return height_px, width_px


def _box(name: bytes, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return (8 + len(content)).to_bytes(4, "big") + name + content
