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
from sonarpost.link.state import Errors, Parts, from_plain, pack_part, prefixed, to_plain, unpack_plain

_WHERE: Final = "state of version 0.1"
_FORMAT: Final = 1
_UNNAMED: Final = ("0000", "?")
"""Image and contact identifier of an image without a name."""
_RENAMED: Final[dict[type, dict[str, str]]] = {
    AssembledImage: {"first_at": "first_frame_s", "last_at": "last_frame_s", "told": "reported"},
    AuthenticationCounts: {"sealed": "protected"},
    BlockDecoder: {"last_at": "last_symbol_s"},
    OutgoingImage: {"added_at": "added_s"},
    PeerState: {
        "heard_at": "last_frame_s",
        "newest": "newest_block",
        "span": "block_span",
        "messages": "recent_messages",
        "reported_at": "feedback_s",
        "reported_frames": "feedback_frames",
        "needless": "redundant_symbols",
    },
    PendingCommand: {"asked_at": "added_s", "expires_at": "expires_s", "due_at": "due_s"},
    PendingImage: {
        "first_at": "first_frame_s",
        "last_at": "last_frame_s",
        "news_at": "wait_from_s",
        "heard_at": "last_seen_s",
        "given": "reported",
    },
    QueuedMessage: {"id": "message_id", "added_at": "added_s", "expires_at": "expires_s"},
    QueueState: {
        "interval_s": "packet_interval_s",
        "credit": "image_credit",
        "last_report_at": "last_feedback_s",
        "frames_at_report": "frames_at_feedback",
    },
    SendBlock: {"asked_at": "last_activity_s"},
    V1ReceiverCounts: {"refused": "rejected", "reports": "feedback", "forgotten_sources": "evicted_sources"},
}
"""Fields of version 0.1 that have other names now."""
_T = TypeVar("_T")
_Map = Mapping[str, Any]


def _converts(convert: Callable[[_Map], _T]) -> Callable[[_Map | bytes], _T]:
    """Make a function unpack its argument, and raise FrameError and no other error for malformed state."""

    @wraps(convert)
    def converted(state: _Map | bytes) -> _T:
        try:
            return convert(unpack_plain(dict, state, _WHERE) if isinstance(state, bytes) else state)
        except BadInputError as error:
            raise FrameError(_WHERE, error.field, error.value, error.expected) from error
        except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise FrameError(_WHERE, "", f"{type(error).__name__}: {error}", "state of sonarpost 0.1") from error

    return converted


def _state(state: _Map) -> _Map:
    if state.get("format") != _FORMAT:
        raise FrameError(_WHERE, "format", state.get("format"), str(_FORMAT))
    return state


def _read(kind: type[_T], entry: _Map, **values: object) -> _T:
    """Return a dataclass from a map with the field names of version 0.1; `values` replace fields."""
    names = _RENAMED.get(kind, {})
    return from_plain(kind, {**{names.get(name, name): value for name, value in entry.items()}, **values}, _WHERE)


@_converts
def v1_receiver_parts(state: _Map) -> dict[str, bytes]:
    """Convert the state of the `v1` receiver.

    Args:
        state: The saved bytes, or the map in them; so for all functions that take a `state`.

    Raises:
        FrameError: Not a state of version 0.1. All functions of this module raise it.
    """
    parts = {"counts": pack_part(_read(V1ReceiverCounts, _state(state)["counts"]))}
    for order, source in enumerate(state["sources"]):
        peer = _read(PeerState, source, order=order)
        peer.blocks = {block.number: block for block in map(_block, source["blocks"])}
        peer.rival_blocks = {block.number: block for block in map(_block, source["rivals"])}
        for peer.image_order, entry in enumerate(source["contacts"], start=1):
            contact, stream = entry["contact"] or None, _packed_stream(entry["pieces"], 0)
            image = _read(
                AssembledImage, entry, source=peer.address, contact=contact, stream=stream, order=peer.image_order
            )
            peer.images[image.number] = image
        parts |= peer.parts()
    return parts


def _block(entry: _Map) -> BlockDecoder:
    layers = entry["layers"]
    ends = [[number, link, start + len(data)] for number, link, start, data in layers[-1]["pieces"]] if layers else []
    layering = entry["layering"] or None
    block = _read(BlockDecoder, entry, layering=layering, layers=len(layers), layer_ends=ends)
    block.restore_chunk(_read(SymbolChunk, {"symbols": entry["symbols"]}))
    return block


def _packed_stream(pieces: list[tuple[int, bytes]], length: int) -> object:
    stream = PartialBytes(bytearray(length))
    for start, data in pieces:
        stream.write(start, data)
    return to_plain(stream)


@_converts
def paper_receiver_parts(state: _Map) -> dict[str, bytes]:
    """Convert the state of the `paper` receiver."""
    parts = {"counts": pack_part(_read(PaperReceiverCounts, _state(state)["counts"]))}
    for order, entry in enumerate(state["images"]):
        candidates = [
            {"header": c["header"], "body": _packed_stream(c["pieces"], c["body_length"]), "frames": c["frames"]}
            for c in entry["candidates"]
        ]
        image = _read(PendingImage, entry, candidates=candidates, order=order)
        parts[f"image/{image.source}/{image.image_id}"] = pack_part(image)
    return parts


@_converts
def authentication_parts(state: _Map) -> dict[str, bytes]:
    """Convert the state of the authentication."""
    counts = to_plain(_read(AuthenticationCounts, _state(state)["counts"]))
    parts = {"authentication": pack_part(_read(AuthenticationState, state, counts=counts))}
    for source, newest, seen in state["windows"]:
        window = SavedWindow(source, ReplayWindow(newest, int.from_bytes(seen, "big")))
        parts[f"window/{source}"] = pack_part(window)
    return parts


@_converts
def endpoint_parts(state: _Map) -> dict[str, bytes]:
    """Convert the state of the vessel's endpoint: its receiver, its commands and its message number."""
    parts = {"endpoint": pack_part(_read(EndpointState, _state(state)))}
    parts |= prefixed("v1/", v1_receiver_parts(state["receiver"]))
    for order, entry in enumerate(_state(state["orders"])["orders"], start=1):
        command = _read(PendingCommand, entry, order=order)
        parts[f"commands/command/{command.token}"] = pack_part(command)
    return parts


def vehicle_parts(saved: Parts) -> tuple[dict[str, bytes], Errors]:
    """Convert the parts of a vehicle's endpoint: queue, receiver and authentication; newer parts stay as they are.

    Returns:
        The new parts, and why parts of version 0.1 were skipped.
    """
    parts, errors = dict(saved), dict[str, FrameError]()
    if any(name.startswith(("queue/core", "queue/picture/")) for name in saved):
        old_queue = {name: parts.pop(name) for name in saved if name.startswith("queue/") or name == "packet"}
        found, skipped = queue_parts({name.removeprefix("queue/"): data for name, data in old_queue.items()})
        parts |= prefixed("queue/", found)
        errors |= {name if name == "packet" else f"queue/{name}": error for name, error in skipped.items()}
    for name, prefix, convert in (
        ("heard", "receiver/", v1_receiver_parts),
        ("seal", "authentication/", authentication_parts),
    ):
        if name in saved:
            try:
                parts |= prefixed(prefix, convert(saved[name]))
            except FrameError as error:
                errors[name] = error
    return parts, errors


def queue_parts(parts: Parts) -> tuple[dict[str, bytes], Errors]:
    """Convert the parts of a transmit queue, and the packet in flight in the part `packet`.

    Returns:
        The new parts, and why parts of version 0.1 were skipped. Without `core` the images have no progress, so the
        restored queue sends all of them again.
    """
    errors: dict[str, FrameError] = {}
    converted: dict[str, bytes] = {}
    converters = {"picture": _image_parts, "message": _message_parts, "packet": _packet_parts}
    for name in sorted(parts, key=lambda name: name == "core"):  # the core last: it replaces images without progress
        kind = name.partition("/")[0]
        try:
            if kind in converters:
                converted |= converters[kind](parts[name])
            elif kind == "core":
                converted |= _core_parts(parts)
        except FrameError as error:
            errors[name] = error
    return converted, errors


@_converts
def _image_parts(entry: _Map) -> dict[str, bytes]:
    image_id, contact_id = entry.get("name") or _UNNAMED
    image = _read(OutgoingImage, entry, image_id=image_id, contact_id=contact_id)
    return {f"image/{image.number}": pack_part(image)}


@_converts
def _message_parts(entry: _Map) -> dict[str, bytes]:
    message = _read(QueuedMessage, entry)
    return {f"message/{message.key}": pack_part(message)}


@_converts
def _packet_parts(entry: _Map) -> dict[str, bytes]:
    return {"packet": pack_part(_read(OutgoingPacket, entry))} if entry.get("frames") else {}


@_converts
def _core_parts(saved: Parts) -> dict[str, bytes]:
    """Convert the part `core`, and the images and blocks (in the other parts) whose progress it has."""
    core = _state(unpack_plain(dict, saved["core"], _WHERE))
    sender = _state(core["sender"])
    losses = {rate: [loss, measured_s] for rate, loss, measured_s in core["losses"]}
    tracker = [dict(sender["receivers"]), {receiver: measured for receiver, *measured in sender["meters"]}]
    waiting_copies = [_copies(entry) for entry in sender["messages"]]
    messages = _read(MessageQueue, core)
    parts = {
        "queue": pack_part(_read(QueueState, core, losses=losses, planned_loss=core.get("planned_loss", 0.2))),
        "sender": pack_part(
            _read(SenderState, sender, messages=[waiting_copies, sender["next_message"]], tracker=tracker)
        ),
        "messages": pack_part(messages),
        "waiting": pack_part(_read(WaitingImages, {"numbers": sender["waiting"]})),
    }
    names = {number: (image_id, contact_id) for number, image_id, contact_id in core["names"]}
    for order, (number, sent, *rest) in enumerate(core["sent"], start=1):
        goal, delivered = rest or (0, [])
        image_id, contact_id = names.get(number, _UNNAMED)
        image = _read(
            OutgoingImage,
            unpack_plain(dict, saved[f"picture/{number}"], _WHERE),
            image_id=image_id,
            contact_id=contact_id,
            order=order,
            sent=sent,
            goal=goal,
            delivered=delivered,
            announced=number in sender["announced"],
        )
        parts[f"image/{number}"] = pack_part(image)
        parts[f"image-progress/{number}"] = pack_part(image, "progress")
    for retired, entries in ((False, core["blocks"]), (True, core.get("past", []))):
        for entry in entries:
            fixed = unpack_plain(dict, saved[f"block/{entry['number']}"], _WHERE)
            layering, missing = fixed["layering"] or None, dict(entry["needs"])
            block = _read(SendBlock, {**fixed, **entry}, layering=layering, missing=missing, retired=retired)
            parts[f"block/{block.number}"] = pack_part(block)
            parts[f"block-progress/{block.number}"] = pack_part(block, "progress")
    for order, name in enumerate(core["known"], start=messages.next_key - len(core["known"])):
        parts[f"message-id/{order}"] = pack_part(MessageIdentifier(max(0, order), name))
    return parts


def _copies(entry: list[Any]) -> list[Any]:
    """Return the fields of a `MessageCopies`; an infinite time of the rise became None."""
    number, data, priority, expires_s, copies, after_frame, rises_s, *extra = entry
    rises_s = None if rises_s == float("inf") else rises_s
    return [number, data, priority, expires_s, copies, after_frame, rises_s, *extra]
