"""The acoustic queue as named parts and back, so that a service can save what has changed and another process go on.

Pictures and the contents of blocks are large and do not change, what changes with every packet is small: a service
writes only the parts that differ from those it wrote before.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.coding.blocks import OutgoingImage
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.v1.preview import MAX_NUMBER
from sonarpost.link.queue.messages import LOWEST_PRIORITY, QueuedMessage, WaitingMessages
from sonarpost.link.queue.transmit_queue import ImageName, TransmitQueue
from sonarpost.link.receiver_state import read_field, read_list, read_map, read_number, read_time
from sonarpost.link.sender_state import export_sender, import_picture, restore_sender
from sonarpost.modem.micromodem import RATES

_FORMAT: Final = 1
_WHERE: Final = "queue state"
_MANY: Final = 2**62
_CORE: Final = "core"
_PICTURE: Final = "picture/"
_BLOCK: Final = "block/"
_MESSAGE: Final = "message/"
_FIXED_OF_A_BLOCK: Final = ("kind", "number", "symbol_bytes", "objects", "layering", "contacts", "urgency", "spans")

Part = Mapping[str, object]


def export_queue(queue: TransmitQueue) -> dict[str, Part]:
    """Return the whole state as parts by name: maps, lists, numbers, strings and bytes (msgpack can hold them)."""
    parts: dict[str, Part] = {}
    sender = export_sender(queue.sender)
    sent: list[object] = []
    for picture in _maps(sender.pop("pictures")):
        number = picture["number"]
        sent.append([number, picture.pop("sent"), picture.pop("goal"), picture.pop("settled")])
        known = queue.names.get(number) if isinstance(number, int) else None
        picture["name"] = [] if known is None else [known.image_id, known.contact_id]  # for `salvage_queue`
        parts[f"{_PICTURE}{number}"] = picture
    blocks: dict[str, list[object]] = {"blocks": [], "past": []}
    for kind, listed in blocks.items():
        for block in _maps(sender.pop(kind)):
            name = f"{_BLOCK}{block['number']}"
            parts[name] = {key: block.pop(key) for key in _FIXED_OF_A_BLOCK}
            listed.append({"number": parts[name]["number"], **block})
    for message in queue.messages.waiting.values():
        parts[f"{_MESSAGE}{message.key}"] = _export_message(message)
    parts[_CORE] = {
        "format": _FORMAT,
        "sender": sender,
        "sent": sent,
        **blocks,
        "names": [[number, name.image_id, name.contact_id] for number, name in queue.names.items()],
        "next_key": queue.messages.next_key,
        "served": dict(queue.messages.served),
        "known": list(queue.messages.known),
        "expired": queue.messages.expired,
        "rate": queue.rate,
        "losses": [[rate, float(loss), float(at)] for rate, (loss, at) in queue.rate_choice.losses.items()],
        "interval_s": float(queue.packet_interval_s),
        "credit": float(queue.picture_credit),
        "last_report_at": None if queue.last_report_at is None else float(queue.last_report_at),
        "frames_at_report": queue.frames_at_report,
        "feedback": queue.sender.config.feedback,
        "planned_loss": float(queue.sender.config.worst.loss),
    }
    return parts


def _maps(value: object) -> list[dict[str, object]]:
    assert isinstance(value, list)
    return [dict(entry) for entry in value]


def restore_queue(queue: TransmitQueue, parts: Mapping[str, Part]) -> None:
    """Replace the state of a new queue by the parts that `export_queue` returned; the configuration stays.

    Where the rate in use is not among the configured ones any more, the queue goes on with the configured first one.

    Raises:
        FrameError: They are not parts that it made; the queue must not be used then.
    """
    core = parts.get(_CORE, {})
    if core.get("format") != _FORMAT:
        raise FrameError(_WHERE, "format", core.get("format"), str(_FORMAT))
    progress = dict(_import_progress(entry) for entry in read_list(core, "sent"))
    pictures = [{**part, **progress[read_number(part, "number", 1, MAX_NUMBER)]} for part in _ordered(parts, progress)]
    blocks = {"blocks": _import_blocks(parts, read_list(core, "blocks"))}
    if "past" in core:
        blocks["past"] = _import_blocks(parts, read_list(core, "past"))
    rate = read_number(core, "rate", min(RATES), max(RATES))
    frame_bytes = RATES[rate].frame_bytes
    feedback = read_field(core, "feedback", bool)
    planned_loss = read_time(core, "planned_loss") if "planned_loss" in core else queue.config.expected_loss
    if not 0.0 <= planned_loss <= 0.95:
        raise FrameError(_WHERE, "planned_loss", planned_loss, "0..0.95")
    channel = LossChannel(planned_loss, queue.config.burst_frames)
    queue.sender.config = replace(queue.sender.config, frame_bytes=frame_bytes, feedback=feedback, channels=(channel,))
    restore_sender(queue.sender, {**read_map(core, "sender"), "pictures": pictures, **blocks})
    queue.names = dict(_import_name(entry) for entry in read_list(core, "names"))
    queue.messages = _import_messages(core, parts)
    queue.rate_choice.losses = dict(_import_loss(entry) for entry in read_list(core, "losses"))
    queue.packet_interval_s = max(0.0, read_time(core, "interval_s"))
    queue.picture_credit = read_time(core, "credit")
    queue.last_report_at = None if core.get("last_report_at") is None else read_time(core, "last_report_at")
    queue.frames_at_report = read_number(core, "frames_at_report", 0, _MANY)
    if rate in queue.config.rates:
        queue.rate_choice.current = rate
    else:
        queue.sender.resize(RATES[queue.rate].frame_bytes)


def salvage_queue(queue: TransmitQueue, parts: Mapping[str, Part], now: float) -> tuple[int, list[FrameError]]:
    """Fill a new queue with what can be read of the pictures and messages in parts that `restore_queue` refused.

    What of the pictures has been sent is not known any more: all of them are sent again, and receivers know what they
    have. Of messages, those that no frame has taken yet.

    Args:
        queue: A new one.
        parts: As many as there are.
        now: UTC in seconds.

    Returns:
        How many pictures and messages, and why the others are none.
    """
    pictures: list[tuple[OutgoingImage, ImageName]] = []
    messages: list[QueuedMessage] = []
    refused: list[FrameError] = []
    for name, part in parts.items():
        try:
            if name.startswith(_PICTURE):
                picture = import_picture({**part, "sent": 0})
                pictures.append((picture, _name_in(part, picture.number)))
            elif name.startswith(_MESSAGE):
                messages.append(_import_message(part))
        except BadInputError as error:
            refused.append(FrameError(f"{_WHERE}: {name}", error.field, error.value, error.expected))
    for picture, name_of_it in sorted(pictures, key=lambda found: found[0].added_at):
        queue.add_picture(picture.number, name_of_it, picture.contact, picture.stream, now)
    for message in sorted(messages, key=lambda m: m.key):
        left_s = message.expires_at - now
        queue.add_message(
            message.message_id, message.source, message.data, now, priority=message.priority, lifetime_s=left_s
        )
    return len(pictures) + len(messages), refused


def _name_in(part: Part, number: int) -> ImageName:
    match part.get("name"):
        case [str(image_id), str(contact_id)]:
            return ImageName(image_id, contact_id)
        case _:
            return ImageName(image_of_number(number), "?")


def _export_message(message: QueuedMessage) -> Part:
    return {
        "key": message.key,
        "id": message.message_id,
        "source": message.source,
        "priority": message.priority,
        "added_at": float(message.added_at),
        "expires_at": float(message.expires_at),
        "data": message.data,
    }


def _import_messages(core: Part, parts: Mapping[str, Part]) -> WaitingMessages:
    found = [_import_message(part) for name, part in parts.items() if name.startswith(_MESSAGE)]
    served = read_map(core, "served")
    if not all(isinstance(n, int) for n in served.values()):
        raise FrameError(_WHERE, "served", served, "bytes by program")
    return WaitingMessages(
        {message.key: message for message in sorted(found, key=lambda m: m.key)},
        read_number(core, "next_key", 0, _MANY),
        Counter({name: n for name, n in served.items() if isinstance(n, int)}),
        {name: None for name in read_list(core, "known") if isinstance(name, str)},
        read_number(core, "expired", 0, _MANY),
    )


def _import_message(part: Part) -> QueuedMessage:
    return QueuedMessage(
        read_number(part, "key", 0, _MANY),
        read_field(part, "id", str),
        read_field(part, "source", str),
        read_number(part, "priority", 1, LOWEST_PRIORITY),
        read_time(part, "added_at"),
        read_time(part, "expires_at"),
        read_field(part, "data", bytes),
    )


def _import_blocks(parts: Mapping[str, Part], entries: list[object]) -> list[Part]:
    blocks: list[Part] = []
    for entry in entries:
        fixed = parts.get(f"{_BLOCK}{read_number(entry, 'number', 0, 255)}")
        if fixed is None or not isinstance(entry, Mapping):
            raise FrameError(_WHERE, "blocks", entry, "a block whose part is there")
        blocks.append({**fixed, **entry})
    return blocks


def _ordered(parts: Mapping[str, Part], sent: Mapping[int, object]) -> list[Part]:
    """Return the parts of pictures in the order of `sent`, which is that in which they came."""
    try:
        return [parts[f"{_PICTURE}{number}"] for number in sent]
    except KeyError as error:
        raise FrameError(_WHERE, "pictures", str(error), "every picture named in the core") from error


def _import_progress(entry: object) -> tuple[int, Part]:
    match entry:
        case [int(number), int(sent)]:  # as saved before there were repairs
            return number, {"sent": sent}
        case [int(number), int(sent), int(goal), list(settled)]:
            return number, {"sent": sent, "goal": goal, "settled": settled}
        case _:
            raise FrameError(_WHERE, "sent", entry, "[number, bytes, bytes, ranges]")


def _import_name(entry: object) -> tuple[int, ImageName]:
    match entry:
        case [int(number), str(image_id), str(contact_id)]:
            return number, ImageName(image_id, contact_id)
        case _:
            raise FrameError(_WHERE, "names", entry, "[number, image_id, contact_id]")


def _import_loss(entry: object) -> tuple[int, tuple[float, float]]:
    match entry:
        case [int(rate), float(loss), float(at)] if rate in RATES and 0 <= loss <= 1 and math.isfinite(at):
            return rate, (loss, at)
        case _:
            raise FrameError(_WHERE, "losses", entry, "[rate, share, time]")
