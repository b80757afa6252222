"""Which contact a record is about, for the log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sonarpost import wire
from sonarpost.errors import BadInputError, FrameError, PayloadError
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.paper.frame import parse_frame
from sonarpost.link.frames.v1.frame import Content, SegmentKind, Symbol, SymbolKind, parse_symbol
from sonarpost.link.frames.v1.frame import parse_frame as parse_v1_frame
from sonarpost.link.frames.v1.preview import Preview, entry_shape
from sonarpost.messages import AcousticFrame, Record, Relayed


def context_of_payload(payload: bytes, where: str) -> dict[str, str]:
    """Return `vehicle`, `image_id` and `contact_id` of a record, as far as it says them.

    An envelope is looked into, and an acoustic frame tells its image where its wire format does. What cannot be read
    concerns nobody: saying so is for whoever handles the record.

    Args:
        payload: A record as msgpack, or anything at all.
        where: Key it came on.
    """
    try:
        fields = wire.unpack_map(payload, where)
    except PayloadError:
        return {}
    inside = fields.get("payload")
    if fields.get("type") == Relayed.TYPE and isinstance(inside, bytes):
        # One envelope deep: an envelope in an envelope is refused anyway.
        return {} if _is_envelope(inside, where) else context_of_payload(inside, where)
    data = fields.get("data")
    if fields.get("type") == AcousticFrame.TYPE and isinstance(data, bytes):
        image_id = image_ids_of_frame(data)
        return {} if image_id is None else {"image_id": image_id}
    contact = fields.get("contact")
    about: Mapping[str, object] = contact if isinstance(contact, dict) else {}
    found = {
        "vehicle": fields.get("vehicle_id") or about.get("vehicle_id"),
        "image_id": fields.get("image_id"),
        "contact_id": about.get("contact_id"),
    }
    return {name: value for name, value in found.items() if isinstance(value, str)}


class LogContext:
    """Which contact a payload is about, looked for when somebody wants to know.

    Attributes:
        record: What the payload holds, as soon as that is known: it need not be read again then.
    """

    def __init__(self, payload: bytes, where: str) -> None:
        self.record: Record | None = None
        self._payload = payload
        self._where = where

    def fields(self) -> dict[str, str]:
        """Return what `context_of_payload` does."""
        if self.record is None or isinstance(self.record, (Relayed, AcousticFrame)):
            return context_of_payload(self._payload, self._where)
        about = getattr(self.record, "contact", None)
        found = {
            "vehicle": getattr(self.record, "vehicle_id", None) or getattr(about, "vehicle_id", None),
            "image_id": getattr(self.record, "image_id", None),
            "contact_id": getattr(about, "contact_id", None),
        }
        return {name: value for name, value in found.items() if value is not None}


def _is_envelope(payload: bytes, where: str) -> bool:
    try:
        return wire.unpack_map(payload, where).get("type") == Relayed.TYPE
    except PayloadError:
        return False


def image_ids_of_frame(data: bytes) -> str | None:
    """Return the image a frame belongs to, several with commas between; None where the frame does not say it.

    Frames of the paper's format all say it. Those of v1 do where they hold records of contacts; a symbol of a block of
    pictures belongs to all pictures of its block, which only the receiver knows. Sealed frames say nothing without the
    key.
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
    """Yield the numbers of the contacts whose records are in a frame of v1."""
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
            continue  # the receiver says what is wrong with it


def _contacts_of_symbol(symbol: Symbol) -> Iterator[int]:
    if symbol.kind != SymbolKind.PREVIEW or symbol.index >= symbol.parameter:
        return
    try:
        shape = entry_shape(len(symbol.data))
        if shape.symbols > 1:
            return  # half an entry: nothing says that its number is right
        for place in range(shape.entries):
            entry = symbol.data[place * shape.entry_bytes : (place + 1) * shape.entry_bytes]
            if any(entry):
                yield Preview.unpack(entry, "frame").number
    except BadInputError:
        return
