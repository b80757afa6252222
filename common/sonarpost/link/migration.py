"""State of sonarpost 0.1 converted to the parts of `sonarpost.link.state`.

Version 0.1 saved each receiver, the authentication and the commands as one msgpack map, and the queue as a map `core`
and maps with its immutable content. Each function returns the parts that `restore` of the class accepts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, Final, TypeVar

from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.auth.authentication import AuthenticationCounts, AuthenticationState, ReplayWindow, SavedWindow
from sonarpost.link.coding.block_decoder import BlockDecoder, SymbolChunk
from sonarpost.link.coding.blocks import OutgoingImage, SendBlock
from sonarpost.link.coding.byte_ranges import PartialBytes
from sonarpost.link.downlink.commands import PendingCommand
from sonarpost.link.downlink.vessel_endpoint import EndpointState
from sonarpost.link.frames.paper.receiver import PaperReceiverCounts, PendingImage
from sonarpost.link.frames.v1.receiver import AssembledImage, PeerState, V1ReceiverCounts
from sonarpost.link.frames.v1.sender import SenderState, WaitingImages
from sonarpost.link.queue.messages import MessageIdentifier, MessageQueue, QueuedMessage
from sonarpost.link.queue.transmit_queue import QueueState
from sonarpost.link.sender import OutgoingPacket
from sonarpost.link.state import Errors, Parts, below, from_plain, pack_part, prefixed, to_plain, unpack_plain

_WHERE: Final = "state of version 0.1"
_FORMAT: Final = 1
_T = TypeVar("_T")
_A = TypeVar("_A")
_Map = dict[str, Any]


def _converts(convert: Callable[[_A], _T]) -> Callable[[_A], _T]:
    """Make a function raise FrameError, and no other error, for malformed state."""

    @wraps(convert)
    def converted(argument: _A) -> _T:
        try:
            return convert(argument)
        except BadInputError as error:
            raise FrameError(_WHERE, error.field, error.value, error.expected) from error
        except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise FrameError(_WHERE, "", f"{type(error).__name__}: {error}", "state of sonarpost 0.1") from error

    return converted


def _state(state: _Map) -> _Map:
    if state.get("format") != _FORMAT:
        raise FrameError(_WHERE, "format", state.get("format"), str(_FORMAT))
    return state


def _read(kind: type[_T], entry: _Map, names: Mapping[str, str] | None = None, **values: object) -> _T:
    """Return a dataclass from a map with the field names of version 0.1; `values` replace fields."""
    plain = {(names or {}).get(name, name): value for name, value in entry.items()}
    return from_plain(kind, {**plain, **values}, _WHERE)


@_converts
def v1_receiver_parts(data: bytes) -> dict[str, bytes]:
    """Convert the state of the `v1` receiver.

    Raises:
        FrameError: Not a state of version 0.1. All functions of this module raise it.
    """
    return _v1_receiver_parts(unpack_plain(dict, data, _WHERE))


def _v1_receiver_parts(state: _Map) -> dict[str, bytes]:
    names = {"refused": "rejected", "reports": "feedback", "forgotten_sources": "evicted_sources"}
    parts = {"counts": pack_part(_read(V1ReceiverCounts, _state(state)["counts"], names))}
    names = {
        "heard_at": "last_frame_s",
        "newest": "newest_block",
        "span": "block_span",
        "messages": "recent_messages",
        "reported_at": "feedback_s",
        "reported_frames": "feedback_frames",
        "needless": "redundant_symbols",
    }
    for order, source in enumerate(state["sources"]):
        peer = _read(PeerState, source, names, order=order)
        peer.blocks = {block.number: block for block in map(_block, source["blocks"])}
        peer.rival_blocks = {block.number: block for block in map(_block, source["rivals"])}
        for image_order, entry in enumerate(source["contacts"], start=1):
            image = _assembled_image(peer.address, entry, image_order)
            peer.images[image.number] = image
            peer.image_order = image_order
        parts |= peer.parts()
    return parts


def _block(entry: _Map) -> BlockDecoder:
    layers = entry["layers"]
    ends = [[number, link, start + len(data)] for number, link, start, data in layers[-1]["pieces"]] if layers else []
    block = _read(
        BlockDecoder,
        entry,
        {"last_at": "last_symbol_s"},
        layering=entry["layering"] or None,
        layers=len(layers),
        layer_ends=ends,
    )
    block.restore_chunk(_read(SymbolChunk, {"symbols": entry["symbols"]}))
    return block


def _assembled_image(source: int, entry: _Map, order: int) -> AssembledImage:
    return _read(
        AssembledImage,
        entry,
        {"first_at": "first_frame_s", "last_at": "last_frame_s", "told": "reported"},
        source=source,
        contact=entry["contact"] or None,
        stream=_packed_stream(entry["pieces"], 0),
        order=order,
    )


def _packed_stream(pieces: list[tuple[int, bytes]], length: int) -> object:
    stream = PartialBytes(bytearray(length))
    for start, data in pieces:
        stream.write(start, data)
    return to_plain(stream)


@_converts
def paper_receiver_parts(data: bytes) -> dict[str, bytes]:
    """Convert the state of the `paper` receiver."""
    state = _state(unpack_plain(dict, data, _WHERE))
    parts = {"counts": pack_part(_read(PaperReceiverCounts, state["counts"]))}
    names = {
        "first_at": "first_frame_s",
        "last_at": "last_frame_s",
        "news_at": "wait_from_s",
        "heard_at": "last_seen_s",
        "given": "reported",
    }
    for order, entry in enumerate(state["images"]):
        candidates = [
            {"header": c["header"], "body": _packed_stream(c["pieces"], c["body_length"]), "frames": c["frames"]}
            for c in entry["candidates"]
        ]
        image = _read(PendingImage, entry, names, candidates=candidates, order=order)
        parts[f"image/{image.source}/{image.image_id}"] = pack_part(image)
    return parts


@_converts
def authentication_parts(data: bytes) -> dict[str, bytes]:
    """Convert the state of the authentication."""
    state = _state(unpack_plain(dict, data, _WHERE))
    counts = _read(AuthenticationCounts, state["counts"], {"sealed": "protected"})
    parts = {"authentication": pack_part(_read(AuthenticationState, state, counts=to_plain(counts)))}
    for source, newest, seen in state["windows"]:
        window = SavedWindow(source, ReplayWindow(newest, int.from_bytes(seen, "big")))
        parts[f"window/{source}"] = pack_part(window)
    return parts


@_converts
def endpoint_parts(data: bytes) -> dict[str, bytes]:
    """Convert the state of the vessel's endpoint: its receiver, its commands and its message number."""
    state = _state(unpack_plain(dict, data, _WHERE))
    parts = {"endpoint": pack_part(_read(EndpointState, state))}
    parts |= prefixed("v1/", _v1_receiver_parts(state["receiver"]))
    names = {"asked_at": "added_s", "expires_at": "expires_s", "due_at": "due_s"}
    for order, entry in enumerate(_state(state["orders"])["orders"], start=1):
        command = _read(PendingCommand, entry, names, order=order)
        parts[f"commands/command/{command.token}"] = pack_part(command)
    return parts


def queue_parts(parts: Parts) -> tuple[dict[str, bytes], Errors]:
    """Convert the parts of a transmit queue, and the packet in flight in the part `packet`.

    Returns:
        The new parts, and why parts of version 0.1 were skipped. Without `core` the images have no progress, so the
        restored queue sends all of them again.
    """
    errors: dict[str, FrameError] = {}
    maps: dict[str, _Map] = {}
    for name, data in parts.items():
        try:
            maps[name] = unpack_plain(dict, data, _WHERE)
        except FrameError as error:
            errors[name] = error
    converted: dict[str, bytes] = {}
    for name, convert in (("core", _core_parts), ("packet", _packet_parts)):
        if name in maps:
            try:
                converted |= convert(maps)
            except FrameError as error:
                errors[name] = error
    for name, convert_entry in (("picture", _image_parts), ("message", _message_parts)):
        for rest, entry in below(f"{name}/", maps).items():
            try:
                converted = {**convert_entry(entry), **converted}
            except FrameError as error:
                errors[f"{name}/{rest}"] = error
    return converted, errors


@_converts
def _image_parts(entry: _Map) -> dict[str, bytes]:
    image_id, contact_id = entry.get("name") or ("0000", "?")
    image = _read(OutgoingImage, entry, {"added_at": "added_s"}, image_id=image_id, contact_id=contact_id)
    return {f"image/{image.number}": pack_part(image)}


@_converts
def _message_parts(entry: _Map) -> dict[str, bytes]:
    names = {"id": "message_id", "added_at": "added_s", "expires_at": "expires_s"}
    message = _read(QueuedMessage, entry, names)
    return {f"message/{message.key}": pack_part(message)}


@_converts
def _packet_parts(maps: Mapping[str, _Map]) -> dict[str, bytes]:
    entry = maps["packet"]
    return {"packet": pack_part(_read(OutgoingPacket, entry))} if entry.get("frames") else {}


@_converts
def _core_parts(maps: Mapping[str, _Map]) -> dict[str, bytes]:
    core = _state(maps["core"])
    sender = _state(core["sender"])
    queue = _read(
        QueueState,
        core,
        {
            "interval_s": "packet_interval_s",
            "credit": "image_credit",
            "last_report_at": "last_feedback_s",
            "frames_at_report": "frames_at_feedback",
        },
        losses={rate: [loss, measured_s] for rate, loss, measured_s in core["losses"]},
        planned_loss=core.get("planned_loss", 0.2),
    )
    state = _read(
        SenderState,
        sender,
        messages=[[_message_copies(*entry) for entry in sender["messages"]], sender["next_message"]],
        tracker=[dict(sender["receivers"]), {receiver: measured for receiver, *measured in sender["meters"]}],
    )
    messages = _read(MessageQueue, core)
    parts = {"queue": pack_part(queue), "sender": pack_part(state), "messages": pack_part(messages)}
    parts["waiting"] = pack_part(_read(WaitingImages, {"numbers": sender["waiting"]}))
    names = {number: (image_id, contact_id) for number, image_id, contact_id in core["names"]}
    for order, (number, sent, *rest) in enumerate(core["sent"], start=1):
        goal, settled = rest or (0, [])
        image_id, contact_id = names.get(number, ("0000", "?"))
        image = _read(
            OutgoingImage,
            maps[f"picture/{number}"],
            {"added_at": "added_s"},
            image_id=image_id,
            contact_id=contact_id,
            order=order,
            sent=sent,
            goal=goal,
            delivered=settled,
            announced=number in sender["announced"],
        )
        parts[f"image/{number}"] = pack_part(image)
        parts[f"image-progress/{number}"] = pack_part(image, "progress")
    for retired, entries in ((False, core["blocks"]), (True, core.get("past", []))):
        for entry in entries:
            block = _read(
                SendBlock,
                {**maps[f"block/{entry['number']}"], **entry},
                {"asked_at": "last_activity_s"},
                layering=maps[f"block/{entry['number']}"]["layering"] or None,
                missing=dict(entry["needs"]),
                retired=retired,
            )
            parts[f"block/{block.number}"] = pack_part(block)
            parts[f"block-progress/{block.number}"] = pack_part(block, "progress")
    for order, name in enumerate(core["known"], start=messages.next_key - len(core["known"])):
        parts[f"message-id/{order}"] = pack_part(MessageIdentifier(max(0, order), name))
    return parts


def _message_copies(
    number: int,
    data: bytes,
    priority: int,
    expires_s: float,
    copies: int,
    after_frame: int,
    rises_s: float,
    extra: int = 2,
) -> _Map:
    return {
        "number": number,
        "data": data,
        "priority": priority,
        "expires_s": expires_s,
        "copies": copies,
        "after_frame": after_frame,
        "rises_s": None if rises_s == float("inf") else rises_s,
        "extra": extra,
    }
