"""Images that an acoustic frame belongs to, for the log."""

from __future__ import annotations

from collections.abc import Iterator

from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.paper.frame import parse_frame
from sonarpost.link.frames.v1.frame import Content, SegmentKind, Symbol, SymbolKind, parse_symbol
from sonarpost.link.frames.v1.frame import parse_frame as parse_v1_frame
from sonarpost.link.frames.v1.payload_objects import Preview, entry_shape


def image_ids_of_frame(data: bytes) -> str | None:
    """Return the identifier of the image that a frame belongs to, several separated by commas; None if unknown.

    Every frame of the paper's format holds it, and v1 frames with contact records do. A symbol of a block belongs to
    all images of the block, which only the receiver knows. Authenticated frames are not parsed here.
    """
    try:
        content = parse_v1_frame(data)
    except FrameError:
        return _image_of_paper_frame(data)
    return ",".join(dict.fromkeys(image_of_number(number) for number in _contacts(content))) or None


def _image_of_paper_frame(data: bytes) -> str | None:
    try:
        return parse_frame(data).image_id
    except FrameError:
        return None


def _contacts(content: Content) -> Iterator[int]:
    """Yield the numbers of the contacts whose records are in a v1 frame."""
    if isinstance(content, Symbol):
        yield from _contacts_of_symbol(content)
        return
    for segment in content:
        try:
            if segment.kind in (SegmentKind.CONTACT, SegmentKind.PREVIEW):
                yield Preview.unpack(segment.data, "frame").number
            elif segment.kind == SegmentKind.SYMBOL:
                yield from _contacts_of_symbol(parse_symbol(segment.data))
        except BadInputError:
            continue  # the receiver reports the error


def _contacts_of_symbol(symbol: Symbol) -> Iterator[int]:
    if symbol.kind != SymbolKind.PREVIEW or symbol.index >= symbol.parameter:
        return
    try:
        shape = entry_shape(len(symbol.data))
        if shape.symbols > 1:
            return  # half an entry: its number cannot be verified
        for index in range(shape.entries):
            entry = symbol.data[index * shape.entry_bytes : (index + 1) * shape.entry_bytes]
            if any(entry):
                yield Preview.unpack(entry, "frame").number
    except BadInputError:
        return
