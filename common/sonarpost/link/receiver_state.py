"""Senders as the v1 receiver knows them, as plain maps and back, so that a service can save them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.coding.block_decoder import BlockDecoder
from sonarpost.link.coding.byte_ranges import Ranges, add_range
from sonarpost.link.coding.erasure_code import MAX_SYMBOLS
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.feedback import WINDOW
from sonarpost.link.frames.v1.frame import BLOCKS, SymbolKind
from sonarpost.link.frames.v1.layers import Layering
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES, PieceList, StreamPiece
from sonarpost.link.frames.v1.preview import MAX_NUMBER
from sonarpost.link.peer_state import PeerState
from sonarpost.link.received_contact import KnownContact

_WHERE = "receiver state"
_T = TypeVar("_T")


def read_map(entry: object, name: str) -> Mapping[str, object]:
    """Return `entry[name]` if it is a map; raise FrameError otherwise."""
    value: Mapping[str, object] = read_field(entry, name, dict)
    return value


def read_list(entry: object, name: str) -> list[object]:
    """Return `entry[name]` if it is a list; raise FrameError otherwise."""
    value: list[object] = read_field(entry, name, list)
    return value


def read_field(entry: object, name: str, kind: type[_T]) -> _T:
    """Return `entry[name]` if it is exactly a `kind`; raise FrameError otherwise."""
    value = entry.get(name) if isinstance(entry, Mapping) else None
    if type(value) is not kind:
        raise FrameError(_WHERE, name, value, kind.__name__)
    return value


def read_number(entry: object, name: str, low: int, high: int) -> int:
    """Return `entry[name]` if it is a whole number in range; raise FrameError otherwise."""
    value = read_field(entry, name, int)
    if not low <= value <= high:
        raise FrameError(_WHERE, name, value, f"{low}..{high}")
    return value


def read_time(entry: object, name: str) -> float:
    """Return `entry[name]` if it is a finite number of seconds; raise FrameError otherwise."""
    value = read_field(entry, name, float)
    if not math.isfinite(value):
        raise FrameError(_WHERE, name, value, "a finite time in seconds")
    return value


def export_source(source: PeerState) -> dict[str, object]:
    """Return a sender as a map."""
    return {
        "address": source.address,
        "heard_at": source.heard_at,
        "frames": source.frames,
        "newest": source.newest,
        "span": source.span,
        "blocks": [_export_block(block) for block in source.blocks.values()],
        "rivals": [_export_block(block) for block in source.rivals.values()],
        "contacts": [_export_contact(contact) for contact in source.contacts.values()],
        "messages": [list(message) for message in source.messages],
        "reported_at": source.reported_at,
        "reported_frames": source.reported_frames,
        "needless": source.needless,
    }


def import_source(entry: object) -> PeerState:
    """Return the sender that `export_source` wrote.

    Raises:
        FrameError: It did not write this.
    """
    address = read_number(entry, "address", -(2**31), 2**31)
    try:
        blocks = [_import_block(e) for e in read_list(entry, "blocks")]
        rivals = [_import_block(e) for e in read_list(entry, "rivals")]
        contacts = [_import_contact(address, e) for e in read_list(entry, "contacts")]
    except BadInputError as error:
        raise FrameError(_WHERE, f"sender {address}, {error.field}", error.value, error.expected) from error
    return PeerState(
        address=address,
        heard_at=read_time(entry, "heard_at"),
        frames=read_number(entry, "frames", 0, 2**62),
        newest=read_number(entry, "newest", -1, BLOCKS - 1),
        span=read_number(entry, "span", 0, WINDOW),
        blocks={block.number: block for block in blocks},
        rivals={block.number: block for block in rivals},
        contacts={contact.number: contact for contact in contacts},
        messages=[_message(e) for e in read_list(entry, "messages")],
        reported_at=read_time(entry, "reported_at"),
        reported_frames=read_number(entry, "reported_frames", 0, 2**62),
        needless=read_number(entry, "needless", 0, 2**62),
    )


def _message(entry: object) -> tuple[int, int, float]:
    match entry:
        case [int() as number, int() as digest, float() as at] if 0 <= number <= 255 and math.isfinite(at):
            return number, digest, at
        case _:
            raise FrameError(_WHERE, "messages", entry, "[number, digest, time]")


def _export_block(block: BlockDecoder) -> dict[str, object]:
    return {
        "kind": int(block.kind),
        "number": block.number,
        "symbol_bytes": block.symbol_bytes,
        "count": block.count,
        "last_at": block.last_at,
        "symbols": [[index, data, block.told.get(index, 0)] for index, data in block.symbols.items()],
        "layering": block.layering.pack() if block.layering is not None else b"",
        "layers": [_export_pieces(pieces) for pieces in block.layers],
        "complete": block.complete,
        "mixed": block.mixed,
    }


def _import_block(entry: object) -> BlockDecoder:
    kind = read_number(entry, "kind", 0, 3)
    if kind not in tuple(SymbolKind):
        raise FrameError(_WHERE, "kind", kind, "0, 1 or 3")
    packed = read_field(entry, "layering", bytes)
    if len(packed) not in (0, 4):
        raise FrameError(_WHERE, "layering", packed, "0 or 4 bytes")
    block = BlockDecoder(
        kind=SymbolKind(kind),
        number=read_number(entry, "number", 0, BLOCKS - 1),
        symbol_bytes=read_number(entry, "symbol_bytes", 1, 65535),
        count=read_number(entry, "count", 0 if kind == SymbolKind.LAYERED else 1, MAX_SYMBOLS),
        last_at=read_time(entry, "last_at"),
        layering=Layering.unpack(packed) if packed else None,
        layers=[_import_pieces(e) for e in read_list(entry, "layers")],
        complete=read_field(entry, "complete", bool),
        mixed=read_number(entry, "mixed", 0, 2**62),
    )
    length = 4 if block.complete else block.symbol_bytes
    for symbol in read_list(entry, "symbols"):
        match symbol:
            case [int() as index, bytes() as data, int() as told] if (
                0 <= index < MAX_SYMBOLS and len(data) == length and 0 <= told <= 255
            ):
                block.symbols[index] = data
                if block.kind == SymbolKind.LAYERED and not block.complete:
                    block.told[index] = told
            case _:
                raise FrameError(_WHERE, "symbols", symbol, f"[index, {length} bytes, descriptor symbol]")
    return block


def _export_pieces(pieces: PieceList) -> dict[str, object]:
    return {"final": pieces.final, "pieces": [[p.number, p.link, p.start, p.data] for p in pieces.pieces]}


def _import_pieces(entry: object) -> PieceList:
    found = []
    for piece in read_list(entry, "pieces"):
        match piece:
            case [int() as number, int() as link, int() as start, bytes() as data] if (
                1 <= number <= MAX_NUMBER and 0 <= link <= 255 and 0 <= start <= MAX_STREAM_BYTES - len(data)
            ):
                found.append(StreamPiece(number, link, start, data))
            case _:
                raise FrameError(_WHERE, "pieces", piece, "[number, link, start, bytes]")
    return PieceList(tuple(found), read_field(entry, "final", bool))


def _export_contact(known: KnownContact) -> dict[str, object]:
    return {
        "number": known.number,
        "first_at": known.first_at,
        "last_at": known.last_at,
        "contact": b"" if known.contact is None else known.contact.pack(),
        "link": known.link,
        "pieces": [[start, bytes(known.stream[start:stop])] for start, stop in known.there],
        "end": known.end,
        "version": known.version,
        "told": list(known.told),
    }


def _import_contact(address: int, entry: object) -> KnownContact:
    packed = read_field(entry, "contact", bytes)
    stream = bytearray()
    there: Ranges = ()
    for piece in read_list(entry, "pieces"):
        match piece:
            case [int() as start, bytes() as data] if start >= 0 and start + len(data) <= MAX_STREAM_BYTES:
                stream.extend(bytes(max(0, start + len(data) - len(stream))))
                stream[start : start + len(data)] = data
                there = add_range(there, start, start + len(data))
            case _:
                raise FrameError(_WHERE, "pieces", piece, f"[position, bytes] within {MAX_STREAM_BYTES}")
    match read_list(entry, "told"):
        case [int() as told_bytes, bool() as told_complete]:
            told = told_bytes, told_complete
        case other:
            raise FrameError(_WHERE, "told", other, "[bytes, completeness]")
    return KnownContact(
        source=address,
        number=read_number(entry, "number", 1, MAX_NUMBER),
        first_at=read_time(entry, "first_at"),
        last_at=read_time(entry, "last_at"),
        contact=ContactSummary.unpack(packed) if packed else None,
        link=read_number(entry, "link", 0, 255),
        stream=stream,
        there=there,
        end=read_number(entry, "end", 0, MAX_STREAM_BYTES),
        version=read_number(entry, "version", 0, 2**62),
        told=told,
    )
