"""The v1 sender as plain maps and back, so that a service can save it and another process go on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeGuard

import numpy as np

from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.coding.blocks import OutgoingImage, SendBlock, StreamSpan
from sonarpost.link.coding.byte_ranges import Ranges, add_range
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.v1.frame import BLOCKS, Segment, SymbolKind
from sonarpost.link.frames.v1.layers import Layering
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES
from sonarpost.link.frames.v1.preview import MAX_NUMBER
from sonarpost.link.receiver_state import read_field, read_list, read_number, read_time
from sonarpost.link.sender import LinkSender
from sonarpost.link.sender_feedback import FeedbackTracker, LossMeter
from sonarpost.link.sender_messages import MessageQueue, WaitingMessage

_FORMAT = 1
_WHERE = "sender state"
_MANY = 2**62


def export_sender(sender: LinkSender) -> dict[str, object]:
    """Return the whole state as maps, lists, numbers, strings and bytes (msgpack can hold it)."""
    pictures = {p.number: p for p in (*sender.kept.values(), *sender.waiting)}
    return {
        "format": _FORMAT,
        "pictures": [_export_picture(p) for p in pictures.values()],
        "waiting": [p.number for p in sender.waiting],
        "blocks": [_export_block(b) for b in sender.blocks],
        "past": [_export_block(b) for b in sender.past],
        "messages": [
            [m.number, m.data, m.priority, m.expires_at, m.copies, m.after_frame, m.rises_at, m.extra]
            for m in sender.messages.waiting
        ],
        "next_message": sender.messages.next_number,
        "reports": [[s.kind, s.data] for s in sender.reports],
        "next_block": sender.next_block,
        "frames_sent": sender.frames_sent,
        "announced": sorted(sender.announced),
        "receivers": [[receiver, float(at)] for receiver, at in sender.book.receivers.items()],
        "meters": [
            [receiver, m.loss, None if m.told is None else list(m.told)] for receiver, m in sender.book.meters.items()
        ],
    }


def restore_sender(sender: LinkSender, state: Mapping[str, object]) -> None:
    """Replace the whole state of a sender by one that `export_sender` returned; the configuration stays.

    Raises:
        FrameError: The state is not one that it made; the sender is then as before.
    """
    if state.get("format") != _FORMAT:
        raise FrameError(_WHERE, "format", state.get("format"), str(_FORMAT))
    try:
        pictures = [import_picture(entry) for entry in read_list(state, "pictures")]
        blocks = [_import_block(entry) for entry in read_list(state, "blocks")]
        past = [_import_block(entry) for entry in _later(state, "past")]
        messages = [_import_message(entry) for entry in read_list(state, "messages")]
        reports = [_import_report(entry) for entry in read_list(state, "reports")]
        queue = MessageQueue(messages, read_number(state, "next_message", 0, 255))
        receivers = dict(_import_receiver(entry) for entry in read_list(state, "receivers"))
        meters = dict(_import_meter(entry) for entry in read_list(state, "meters"))
        next_block = read_number(state, "next_block", 0, BLOCKS - 1)
        frames_sent = read_number(state, "frames_sent", 0, _MANY)
        announced = {n for n in read_list(state, "announced") if isinstance(n, int)}
        by_number = {p.number: p for p in pictures}
        waiting = [by_number.get(n) if isinstance(n, int) else None for n in read_list(state, "waiting")]
    except BadInputError as error:
        raise FrameError(_WHERE, error.field, error.value, error.expected) from error
    if None in waiting:
        raise FrameError(_WHERE, "waiting", state.get("waiting"), "numbers of pictures in the state")
    sender.kept = by_number
    sender.waiting = [p for p in waiting if p is not None]
    sender.blocks, sender.past, sender.messages, sender.reports = blocks, past, queue, reports
    sender.book = FeedbackTracker(receivers, meters)
    sender.next_block, sender.frames_sent, sender.announced = next_block, frames_sent, announced


def _export_picture(picture: OutgoingImage) -> dict[str, object]:
    return {
        "number": picture.number,
        "contact": picture.contact.pack(),
        "stream": picture.stream,
        "curve": picture.curve.astype("<f8").tobytes(),
        "added_at": float(picture.added_at),
        "sent": picture.sent,
        "goal": picture.goal,
        "settled": [list(part) for part in picture.settled],
    }


def _later(entry: object, name: str) -> list[object]:
    """Return a list that states saved by earlier versions do not have."""
    return read_list(entry, name) if isinstance(entry, Mapping) and name in entry else []


def import_picture(entry: object) -> OutgoingImage:
    """Return a picture as `export_sender` wrote it.

    Raises:
        BadInputError: It did not write this.
    """
    if not isinstance(entry, Mapping):
        raise FrameError(_WHERE, "pictures", entry, "maps")
    stream, raw = read_field(entry, "stream", bytes), read_field(entry, "curve", bytes)
    if not 1 <= len(stream) <= MAX_STREAM_BYTES or len(raw) != 8 * (len(stream) + 1):
        raise FrameError(_WHERE, "curve", f"{len(raw)} bytes", "8 for each length of a stream of 1..65535 bytes")
    curve = np.frombuffer(raw, "<f8").astype(np.float64)
    if not np.isfinite(curve).all():
        raise FrameError(_WHERE, "curve", "not finite", "finite values in dB")
    return OutgoingImage(
        number=read_number(entry, "number", 1, MAX_NUMBER),
        contact=ContactSummary.unpack(read_field(entry, "contact", bytes)),
        stream=stream,
        curve=curve,
        added_at=read_time(entry, "added_at"),
        sent=read_number(entry, "sent", 0, len(stream)),
        goal=read_number({"goal": 0, **entry}, "goal", 0, MAX_STREAM_BYTES),
        settled=_import_ranges(_later(entry, "settled"), len(stream)),
    )


def _import_ranges(entries: list[object], length: int) -> Ranges:
    ranges: Ranges = ()
    for entry in entries:
        match entry:
            case [int(start), int(stop)] if 0 <= start < stop <= length:
                ranges = add_range(ranges, start, stop)
            case _:
                raise FrameError(_WHERE, "settled", entry, f"[start, stop] within {length}")
    return ranges


def _export_block(block: SendBlock) -> dict[str, object]:
    return {
        "kind": int(block.kind),
        "number": block.number,
        "symbol_bytes": block.symbol_bytes,
        "objects": list(block.objects),
        "layering": b"" if block.layering is None else block.layering.pack(),
        "contacts": list(block.contacts),
        "urgency": float(block.urgency),
        "planned": block.planned,
        "sent": block.sent,
        "reported": block.reported,
        "asked_at": float(block.asked_at),
        "needs": [list(item) for item in block.needs.items()],
        "spans": [list(span) for span in block.spans],
    }


def _import_block(entry: object) -> SendBlock:
    kind = read_number(entry, "kind", 0, 3)
    packed = read_field(entry, "layering", bytes)
    if kind not in tuple(SymbolKind) or len(packed) != (4 if kind == SymbolKind.LAYERED else 0):
        raise FrameError(_WHERE, "layering", packed, "four bytes of a layered block, none of others")
    layering = Layering.unpack(packed) if packed else None
    symbol_bytes = read_number(entry, "symbol_bytes", 1, 255)
    objects = tuple(data for data in read_list(entry, "objects") if isinstance(data, bytes))
    lengths = tuple(len(data) for data in objects)
    fits = len(lengths) == 1 and lengths[0] and not lengths[0] % symbol_bytes and lengths[0] <= 255 * symbol_bytes
    if not (lengths == layering.lengths(symbol_bytes) if layering else fits):
        raise FrameError(_WHERE, "objects", lengths, "whole symbols of one object, or each layer's object")
    return SendBlock(
        kind=SymbolKind(kind),
        number=read_number(entry, "number", 0, BLOCKS - 1),
        symbol_bytes=symbol_bytes,
        objects=objects,
        layering=layering,
        contacts=tuple(n for n in read_list(entry, "contacts") if isinstance(n, int)),
        urgency=max(read_time(entry, "urgency"), 1e-3),
        planned=read_number(entry, "planned", 0, _MANY),
        sent=read_number(entry, "sent", 0, _MANY),
        reported=read_field(entry, "reported", bool),
        asked_at=read_time(entry, "asked_at"),
        needs=dict(_import_need(e) for e in read_list(entry, "needs")),
        spans=tuple(_import_span(e) for e in _later(entry, "spans")),
    )


def _import_span(entry: object) -> StreamSpan:
    match entry:
        case [int(number), int(link), int(start), int(stop)] if (
            1 <= number <= MAX_NUMBER and 0 <= link <= 255 and 0 <= start <= stop <= MAX_STREAM_BYTES
        ):
            return number, link, start, stop
        case _:
            raise FrameError(_WHERE, "spans", entry, "[number, link, start, stop]")


def _import_message(entry: object) -> WaitingMessage:
    match entry:
        case [
            int(number),
            bytes(data),
            int(priority),
            float(expires_at),
            int(often),
            int(after),
            float(rises_at),
            *extra,
        ] if 0 <= number <= 255 and data and _is_extra(extra):
            return WaitingMessage(number, data, priority, expires_at, often, after, rises_at, *extra)
        case _:
            raise FrameError(_WHERE, "messages", entry, "[number, bytes, priority, time, copies, frame, time, copies]")


def _is_extra(values: list[object]) -> TypeGuard[list[int]]:
    """Whether this is what follows in a message's entry: nothing in states of before, or how many copies more."""
    return not values or (len(values) == 1 and isinstance(values[0], int) and 0 <= values[0] <= 9)


def _import_report(entry: object) -> Segment:
    match entry:
        case [int(kind), bytes(data)] if 1 <= kind < 32 and len(data) <= 255:
            return Segment(kind, data)
        case _:
            raise FrameError(_WHERE, "reports", entry, "[kind, bytes]")


def _import_receiver(entry: object) -> tuple[int, float]:
    match entry:
        case [int(receiver), float(at)] if math.isfinite(at):
            return receiver, at
        case _:
            raise FrameError(_WHERE, "receivers", entry, "[address, time]")


def _import_meter(entry: object) -> tuple[int, LossMeter]:
    match entry:
        case [int(receiver), None, None]:
            return receiver, LossMeter()
        case [int(receiver), (None | float()) as loss, [int(sent), int(arrived)]] if loss is None or 0 <= loss <= 1:
            return receiver, LossMeter(loss, (sent, arrived))
        case _:
            raise FrameError(_WHERE, "meters", entry, "[address, share, [frames sent, frames arrived]]")


def _import_need(entry: object) -> tuple[int, int]:
    match entry:
        case [int(receiver), int(need)] if 0 <= need <= 255:
            return receiver, need
        case _:
            raise FrameError(_WHERE, "needs", entry, "[address, symbols]")
