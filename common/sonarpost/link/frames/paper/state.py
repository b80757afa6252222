"""Images of the `paper` receiver as plain maps and back, so that a service can save them with its other records."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.coding.byte_ranges import Ranges, add_range
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import is_image_id
from sonarpost.link.frames.paper.pending_image import MAX_CANDIDATES, DeliveredState, ImageCandidate, PendingImage

_WHERE = "receiver state"
_T = TypeVar("_T")

_TIMES = ("first_at", "last_at", "news_at", "heard_at")


def export_image(image: PendingImage) -> dict[str, object]:
    """Return the image as a map of numbers, strings, bytes and lists; of a body only what arrived."""
    return {
        "source": image.source,
        "image_id": image.image_id,
        **{name: getattr(image, name) for name in _TIMES},
        "candidates": [_export_candidate(candidate) for candidate in image.candidates],
        "contact": None if image.contact is None else image.contact.pack(),
        "conflicts": image.conflicts,
        "version": image.version,
        "given": None if image.given is None else list(image.given),
    }


def import_image(entry: object) -> PendingImage:
    """Return the image that `export_image` wrote.

    Raises:
        FrameError: It did not write this.
    """
    image_id = read_field(entry, "image_id", str)
    if not is_image_id(image_id):
        raise FrameError(_WHERE, "image_id", image_id, "four characters 0-9A-Z")
    try:
        candidates = [_import_candidate(image_id, e) for e in read_list(entry, "candidates")]
        packed = _read_optional(entry, "contact", bytes)
        contact = None if packed is None else ContactSummary.unpack(packed)
    except BadInputError as error:
        raise FrameError(_WHERE, f"image {image_id}, {error.field}", error.value, error.expected) from error
    if len(candidates) > MAX_CANDIDATES or (not candidates and contact is None):
        raise FrameError(_WHERE, f"image {image_id}, candidates", len(candidates), f"0..{MAX_CANDIDATES}, or a contact")
    first_at, last_at, news_at, heard_at = (_read_time(entry, name) for name in _TIMES)
    return PendingImage(
        source=read_field(entry, "source", int),
        image_id=image_id,
        first_at=first_at,
        last_at=last_at,
        news_at=news_at,
        heard_at=heard_at,
        candidates=candidates,
        contact=contact,
        conflicts=read_field(entry, "conflicts", int),
        version=read_field(entry, "version", int),
        given=_import_given(entry),
    )


def read_field(entry: object, name: str, kind: type[_T]) -> _T:
    """Return `entry[name]` if `entry` is a map and the value is a `kind`; raise FrameError otherwise."""
    if not isinstance(entry, Mapping):
        raise FrameError(_WHERE, name, entry, "a map that holds it")
    value = entry.get(name)
    if not isinstance(value, kind):
        raise FrameError(_WHERE, name, value, kind.__name__)
    return value


def read_list(entry: object, name: str) -> list[object]:
    """Return `entry[name]` if it is a list; raise FrameError otherwise."""
    values: list[object] = read_field(entry, name, list)
    return values


def _read_optional(entry: object, name: str, kind: type[_T]) -> _T | None:
    if isinstance(entry, Mapping) and entry.get(name) is None:
        return None
    return read_field(entry, name, kind)


def _read_time(entry: object, name: str) -> float:
    value = read_field(entry, name, float)
    if not math.isfinite(value):
        raise FrameError(_WHERE, name, value, "a finite time in seconds")
    return value


def _export_candidate(candidate: ImageCandidate) -> dict[str, object]:
    pieces = [[start, bytes(candidate.body[start:stop])] for start, stop in candidate.received]
    return {
        "header": candidate.header.pack(),
        "body_length": len(candidate.body),
        "pieces": pieces,
        "frames": candidate.frames,
    }


def _import_candidate(image_id: str, entry: object) -> ImageCandidate:
    packed = read_field(entry, "header", bytes)
    header = StreamHeader.unpack(packed)
    if len(packed) != header.size:
        raise FrameError(_WHERE, "header", packed, f"{header.size} bytes")
    body_length = read_field(entry, "body_length", int)
    if not 0 <= body_length <= 0xFFFF:
        raise FrameError(_WHERE, "body_length", body_length, "0..65535")
    body = bytearray(body_length)
    received: Ranges = ()
    for piece in read_list(entry, "pieces"):
        match piece:
            case [int() as start, bytes() as data] if start >= 0 and start + len(data) <= len(body):
                body[start : start + len(data)] = data
                received = add_range(received, start, start + len(data))
            case _:
                raise FrameError(_WHERE, "pieces", piece, f"[position, bytes] within {len(body)} bytes")
    return ImageCandidate(header, body, received, read_field(entry, "frames", int))


def _import_given(entry: object) -> DeliveredState | None:
    given = _read_optional(entry, "given", list)
    match given:
        case None:
            return None
        case [int() as leader, int() as received_bytes, bool() as has_contact]:
            return leader, received_bytes, has_contact
        case _:
            raise FrameError(_WHERE, "given", given, "[leader, body bytes, contact known]")
