"""Coded images on thin links: whole records, and differences to a version that both sides have.

The vessel's relay and the shore's c2 both store the last version of an image that c2 has accepted. The relay sends a
later version as the difference to it. c2 applies a difference to the version that it has, which may be later than the
one that the relay names, and accepts the result only if its CRC-32 is right. docs/specifications/zenoh.md specifies the
records and these rules for other languages.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import msgpack
import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from sonarpost import wire
from sonarpost.codec.registry import default_registry
from sonarpost.errors import BadInputError, FrameError, MissingBaseError, PayloadError
from sonarpost.link.frames.contact_record import RECORD_SIZE, contact_and_size, exact_record
from sonarpost.logs import kv
from sonarpost.messages import CodedImage, Contact, ImagePart

log = logging.getLogger(__name__)

MAX_VERSIONS: Final = 2048
"""Images of one vessel (c2) or for one site (relay) whose last version is kept for differences; at most 192 MiB
with the surplus ones."""
PRUNE_EVERY: Final = 1024
"""Number of stored versions after which surplus ones are deleted, and after a start: their search reads all names."""
MERGED_GAP_BYTES: Final = 5
"""Equal bytes between two pieces that are sent again, because a further piece would be as long."""

TIME_STEPS: Final = 1 << 22
"""Units of `d` a second."""

_COMPLETE, _AUTHENTICATED, _UNAUTHENTICATED, _TOP, _BOTTOM = 1, 2, 4, 8, 16
_HALVES: Final = {0: (), _TOP: ("top",), _BOTTOM: ("bottom",), _TOP | _BOTTOM: ("top", "bottom")}


def whole_part(image: CodedImage) -> ImagePart:
    """Return the record of a whole image for a shore site.

    Raises:
        PayloadError: The contact is too long.
    """
    packed = _pack_contact(image)
    has_size = len(packed) == RECORD_SIZE
    length, missing = len(image.stream), image.missing
    received = length - sum(stop - start for start, stop in missing)
    delay = max(0, round((image.last_frame_utc_s - image.first_frame_utc_s) * TIME_STEPS))
    authenticated = {None: 0, True: _AUTHENTICATED, False: _UNAUTHENTICATED}[image.authenticated]
    fields = {
        "u": image.vehicle_id,
        "i": image.image_id,
        "n": image.version,
        "t": image.first_frame_utc_s,
        "d": delay,
        "l": None
        if _last_frame_utc_s(image.first_frame_utc_s, delay) == image.last_frame_utc_s
        else image.last_frame_utc_s,
        "c": packed,
        "h": None if has_size else image.height_px,
        "w": None if has_size else image.width_px,
        **(_pieces(image.stream, _mask(length, missing)) | {"m": missing} if missing else {"p": image.stream}),
        "x": image.pixels_crc32,
        "f": image.frames_received,
        "e": None if image.bytes_total == length else image.bytes_total,
        "y": None if image.bytes_received == received else image.bytes_received,
        "q": image.conflicts,
        "g": (
            (_COMPLETE if image.complete else 0)
            | authenticated
            | (_TOP if "top" in image.missing_halves else 0)
            | (_BOTTOM if "bottom" in image.missing_halves else 0)
        ),
        "a": bytes.fromhex(image.model),
    }
    return wire.validated(ImagePart, fields, ImagePart.TYPE)


def difference(image: ImagePart, base: ImagePart) -> ImagePart:
    """Return the difference between a whole image and an earlier whole version of it.

    It can be longer than the image. It is the image itself if the later version lacks the contact or the codebook of
    the earlier one.
    """
    lacks = (base.c and not image.c) or (base.a and not image.a)
    stream, earlier = np.frombuffer(stream_of(image), np.uint8), np.frombuffer(stream_of(base), np.uint8)
    if base.n >= image.n or lacks or (not image.c and (image.h, image.w) != (base.h, base.w)):
        return image
    known = _mask(stream.size, image.m)
    same = np.zeros(stream.size, dtype=np.bool_)
    common = min(stream.size, earlier.size)
    same[:common] = _mask(earlier.size, base.m)[:common] & (stream[:common] == earlier[:common])
    unchanged_contact = (image.c, image.h, image.w) == (base.c, base.h, base.w)
    return image.model_copy(
        update={
            "b": base.n,
            **_pieces(stream.tobytes(), _merged(known & ~same, known)),
            "k": _checksum(stream.tobytes(), image.c),
            "c": b"" if unchanged_contact else image.c,
            "h": None if unchanged_contact else image.h,
            "w": None if unchanged_contact else image.w,
            "a": b"" if image.a == base.a else image.a,
        }
    )


def expand(part: ImagePart, base: ImagePart | None, where: str) -> ImagePart:
    """Return the whole image of a record.

    Args:
        part: A whole image, which is returned as it is, or a difference.
        base: The last version that was accepted; None if there is none.
        where: Key of the record, for errors.

    Raises:
        MissingBaseError: It is the difference to a version that is not known, or does not fit it.
    """
    if part.b == 0:
        return part
    if base is None or base.n < part.b:
        raise MissingBaseError(where, "b", part.b, "a version that this site has; send the whole image")
    stream = bytearray(length_of(part))
    earlier = stream_of(base)[: len(stream)]
    stream[: len(earlier)] = earlier
    for first, content in pieces_of(part):
        stream[first : first + len(content)] = content
    for start, stop in part.m:
        stream[start:stop] = bytes(stop - start)
    contact, size = (part.c, (part.h, part.w)) if part.c else (base.c, (base.h, base.w))
    found = _checksum(bytes(stream), contact)
    if found != part.k:
        raise MissingBaseError(where, "k", part.k, f"{found}, the checksum of the result; send the whole image")
    changes: dict[str, object] = {
        "b": 0,
        "k": None,
        "c": contact,
        "h": size[0],
        "w": size[1],
        **_pieces(bytes(stream), _mask(len(stream), part.m)),
        "a": part.a or base.a,
    }
    return part.model_copy(update=changes)


def stream_of(part: ImagePart) -> bytes:
    """Return the stream of a whole image, with zeros in the missing ranges."""
    if not part.s and part.z is None:
        return part.p
    stream = bytearray(length_of(part))
    for first, content in pieces_of(part):
        stream[first : first + len(content)] = content
    return bytes(stream)


def pieces_of(part: ImagePart) -> tuple[tuple[int, bytes], ...]:
    """Return all pieces of the stream: first byte and content."""
    return ((0, part.p), *part.s) if part.p else part.s


def length_of(part: ImagePart) -> int:
    """Return the length of the stream."""
    if part.z is not None:
        return part.z
    first, content = pieces_of(part)[-1] if part.p or part.s else (0, b"")
    return first + len(content)


def coded_image(part: ImagePart, vessel_id: str, where: str) -> CodedImage:
    """Return the coded image that a whole record represents.

    Raises:
        PayloadError: The contact is invalid, a byte of the stream is neither present nor missing, or one is both.
    """
    stream = stream_of(part)
    received = len(part.p) + sum([len(content) for _, content in part.s])
    if part.m or received != len(stream):
        pieces = np.zeros(len(stream), dtype=np.bool_)
        for first, content in pieces_of(part):
            pieces[first : first + len(content)] = True
        if not np.array_equal(pieces, _mask(len(stream), part.m)):
            raise PayloadError(where, "s", f"{int(pieces.sum())} bytes", "every byte of the stream that is not in m")
    contact, height_px, width_px = _unpack_contact(part, where)
    authenticated = True if part.g & _AUTHENTICATED else False if part.g & _UNAUTHENTICATED else None
    fields: dict[str, object] = {
        "vessel_id": vessel_id,
        "vehicle_id": part.u,
        "image_id": part.i,
        "version": part.n,
        "contact": contact,
        "height_px": height_px,
        "width_px": width_px,
        "stream": stream,
        "missing": part.m,
        "missing_halves": _HALVES[part.g & (_TOP | _BOTTOM)],
        "complete": bool(part.g & _COMPLETE),
        "bytes_received": received if part.y is None else part.y,
        "bytes_total": len(stream) if part.e is None else part.e,
        "frames_received": part.f,
        "conflicts": part.q,
        "first_frame_utc_s": part.t,
        "last_frame_utc_s": _last_frame_utc_s(part.t, part.d) if part.l is None else part.l,
        "authenticated": authenticated,
        "codec": codec_name(stream),
        "model": part.a.hex(),
        "pixels_crc32": part.x,
    }
    return wire.validated(CodedImage, fields, where)


def codec_name(stream: bytes) -> str:
    """Return the name of the codec of a stream; empty if it has no header or its codec is not known."""
    if not stream:
        return ""
    try:
        return default_registry().spec_for_id(stream[0]).name
    except BadInputError:
        return ""


class PartHead(NamedTuple):
    """What identifies a record `part`.

    Attributes:
        subject: Name of the image on its vessel; a store keeps its last version under this name with a prefix.
        version: Version of the image.
        base: Version to which the record is the difference; 0 for a whole image.
    """

    subject: str
    version: int
    base: int


def head_of(payload: bytes) -> PartHead:
    """Return what identifies a valid encoded record `part`."""
    fields = msgpack.unpackb(payload)
    return PartHead(subject(fields["u"], fields["i"], fields["t"]), fields["n"], fields.get("b", 0))


def subject(vehicle_id: str, image_id: str, first_frame_utc_s: float) -> str:
    """Return a name of an image on its vessel; the time distinguishes images after a restart of the identifiers."""
    return f"{vehicle_id}/{image_id}/{float(first_frame_utc_s)!r}"


def stored_version(value: bytes | None, name: str) -> ImagePart | None:
    """Return the version that a store keeps under a name; None for none, or if it cannot be read."""
    try:
        return None if value is None else wire.decode(ImagePart, value, name)
    except PayloadError as error:
        log.warning("Image version cannot be read; the whole image replaces it", extra=kv(reason=str(error)))
        return None


def stored_number(value: bytes | None) -> int:
    """Return the number of a version that a store keeps; 0 for none, or if it cannot be read."""
    try:
        return 0 if value is None else head_of(value).version
    except (ValueError, TypeError, LookupError):
        return 0


def surplus_names(names: Sequence[str]) -> Sequence[str]:
    """Return those names of stored versions that are beyond `MAX_VERSIONS`, the oldest images."""
    by_time = sorted(names, key=lambda name: float(name.rpartition("/")[2]))
    return by_time[: max(0, len(names) - MAX_VERSIONS)]


def _pack_contact(image: CodedImage) -> bytes:
    contact = image.contact
    if contact is None:
        return b""
    usual = _usual_names(image.vehicle_id, image.image_id)
    has_usual_names = usual.items() <= vars(contact).items()
    if has_usual_names and (record := exact_record(contact, image.height_px, image.width_px)):
        return record
    present = {name: value for name, value in contact.model_dump().items() if value is not None}
    fields = {name: value for name, value in present.items() if usual.get(name) != value}
    packed: bytes = msgpack.packb(fields)
    # A site would read a map of that size as a contact record; one with both names is longer.
    return packed if len(packed) != RECORD_SIZE else msgpack.packb(present)


def _unpack_contact(part: ImagePart, where: str) -> tuple[Contact | None, int | None, int | None]:
    if not part.c:
        return None, part.h, part.w
    try:
        if len(part.c) == RECORD_SIZE and part.h is None and part.w is None:
            return contact_and_size(part.c, part.u, part.i, where)
    except (FrameError, ValidationError) as error:
        raise PayloadError(where, "c", part.c, f"a contact record: {error}") from error
    fields = _usual_names(part.u, part.i) | wire.unpack_map(part.c, f"{where}: c")
    return wire.validated(Contact, fields, f"{where}: c"), part.h, part.w


def _usual_names(vehicle_id: str, image_id: str) -> dict[str, object]:
    return {"vehicle_id": vehicle_id, "contact_id": f"{vehicle_id}/{image_id}"}


def _mask(length: int, missing: Sequence[tuple[int, int]]) -> npt.NDArray[np.bool_]:
    """Return shape (length,), True for each byte that is not missing."""
    mask = np.ones(length, dtype=np.bool_)
    for start, stop in missing:
        mask[start:stop] = False
    return mask


def _merged(changed: npt.NDArray[np.bool_], known: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return `changed` with short gaps of known bytes filled."""
    merged = changed.copy()
    runs = _runs(changed)
    for (_, end), (start, _) in pairwise(runs):
        if start - end <= MERGED_GAP_BYTES and known[end:start].all():
            merged[end:start] = True
    return merged


def _pieces(stream: bytes, mask: npt.NDArray[np.bool_]) -> dict[str, Any]:
    """Return the fields with the bytes of a stream for which `mask` is True, and with its length."""
    runs = [(0, mask.size)] if mask.size and mask.all() else _runs(mask)
    first = stream[: runs[0][1]] if runs and runs[0][0] == 0 else b""
    others = tuple((start, stream[start:stop]) for start, stop in runs if start > 0)
    end = runs[-1][1] if runs else 0
    return {"z": None if end == len(stream) else len(stream), "p": first, "s": others}


def _last_frame_utc_s(first_frame_utc_s: float, delay: int) -> float:
    return first_frame_utc_s + delay / TIME_STEPS


def _runs(mask: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last index + 1 of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False]))))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def _checksum(stream: bytes, contact: bytes) -> int:
    return zlib.crc32(contact, zlib.crc32(stream))
