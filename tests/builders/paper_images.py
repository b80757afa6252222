"""Updates of images in the terms of the paper's format: stream header, body, and received ranges of the body."""

from sonarpost.codec.interface import StreamHeader
from sonarpost.link.coding.byte_ranges import Ranges, gaps_within
from sonarpost.link.receiver import ImageUpdate


def header_of(update: ImageUpdate) -> StreamHeader:
    return StreamHeader.unpack(update.stream)


def body_of(update: ImageUpdate) -> bytes:
    return update.stream[header_of(update).size :]


def received_of(update: ImageUpdate) -> Ranges:
    """Return the ranges of the body that have arrived."""
    size = header_of(update).size
    return tuple((a - size, b - size) for a, b in gaps_within(update.missing, size, len(update.stream)))
