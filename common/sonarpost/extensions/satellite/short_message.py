"""Format of short messages: contacts with previews, decisions and acknowledgements in at most 340 bytes.

docs/specifications/short-message.md specifies every byte. The vessel is not part of a message: the receiver identifies
it by the terminal that sent the message.
"""

import binascii
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import msgpack

from sonarpost.errors import BadInputError, PayloadError
from sonarpost.link.frames.contact_record import RECORD_SIZE, ContactSummary, summary_of
from sonarpost.link.frames.paper.frame import IMAGE_ID_COUNT, format_image_id
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import Decision, ReceivedImage
from sonarpost.wire import validated

MAX_MESSAGE_BYTES: Final = 340
"""Longest message from a terminal of the class of the Iridium 9602."""
MAX_ACKNOWLEDGEMENT_BYTES: Final = 43
WINDOW: Final = 256
"""Messages that can be unacknowledged at once."""
MAX_SEQ: Final = 2**32 - 2
"""Highest sequence number: the base of an acknowledgement, which is above it, has 32 bits."""
MAX_FRAGMENTS: Final = 255

_MESSAGE_TYPE: Final = 0xB1
_ACKNOWLEDGEMENT_TYPE: Final = 0xB2
_HEAD: Final = struct.Struct(">BIIB")
_ACKNOWLEDGEMENT: Final = struct.Struct(">BII")
_ITEM: Final = struct.Struct(">BH")
_FRAGMENT: Final = struct.Struct(">IBB")
_CONTACT: Final = struct.Struct(">3sIddB3s3s3sH")
_CRC_BYTES: Final = 2
_WHERE: Final = "short message"
_RECORD_BIT, _COMPLETE_BIT, _AUTHENTICATED_SHIFT = 1, 2, 2
_AUTHENTICATED: Final = (None, False, True)
_DECISION_FIELDS: Final = (
    "decision_id",
    "vehicle_id",
    "image_id",
    "image_version",
    "verdict",
    "confidence",
    "mlo_class",
    "remark",
    "operator",
    "decided_utc_s",
    "withdraws",
    "overrules",
)

HEAD_BYTES: Final = _HEAD.size + _CRC_BYTES
ITEM_HEAD_BYTES: Final = _ITEM.size
MAX_ITEM_BYTES: Final = MAX_MESSAGE_BYTES - HEAD_BYTES - ITEM_HEAD_BYTES
"""Longest content of an item."""
FRAGMENT_BYTES: Final = MAX_ITEM_BYTES - _FRAGMENT.size


class ShortMessageError(BadInputError):
    """A short message is invalid, or a record does not fit the format."""


class ItemType(IntEnum):
    """Types of items."""

    CONTACT = 1
    DECISION = 2
    DECISION_FRAGMENT = 3


@dataclass(frozen=True, slots=True)
class Item:
    """One item of a message: a record, or a fragment of one."""

    type: ItemType
    content: bytes


@dataclass(frozen=True, slots=True)
class ShortMessage:
    """A message from a vessel.

    Attributes:
        epoch: Random number of the sender's store (0..2^32 - 1); sequence numbers count within it.
        seq: Sequence number (0..2^32 - 2).
        oldest: Oldest sequence number that was not acknowledged when the message was made, at most 255 below `seq`.
        items: Its items.
    """

    epoch: int
    seq: int
    oldest: int
    items: tuple[Item, ...]

    def pack(self) -> bytes:
        """Return the bytes; `items_bytes` is their number."""
        items = b"".join(_ITEM.pack(item.type, len(item.content)) + item.content for item in self.items)
        return _with_crc(_HEAD.pack(_MESSAGE_TYPE, self.epoch, self.seq, self.seq - self.oldest) + items)

    @classmethod
    def unpack(cls, data: bytes, where: str = _WHERE) -> "ShortMessage":
        """Parse a message.

        Raises:
            ShortMessageError: It is not a valid message.
        """
        body = _without_crc(data, _HEAD.size, MAX_MESSAGE_BYTES, where)
        message_type, epoch, seq, behind = _HEAD.unpack_from(body)
        if message_type != _MESSAGE_TYPE:
            raise ShortMessageError(where, "type", message_type, f"{_MESSAGE_TYPE:#x}")
        if seq > MAX_SEQ:
            raise ShortMessageError(where, "seq", seq, f"at most {MAX_SEQ}")
        if behind > seq:
            raise ShortMessageError(where, "oldest", seq - behind, "0 or more")
        items, offset = [], _HEAD.size
        while offset < len(body):
            if len(body) - offset < _ITEM.size:
                raise ShortMessageError(where, "item", len(body) - offset, f"at least {_ITEM.size} bytes")
            number, length = _ITEM.unpack_from(body, offset)
            offset += _ITEM.size
            if number not in ItemType.__members__.values():
                raise ShortMessageError(where, "item type", number, "1 to 3")
            if length > len(body) - offset:
                raise ShortMessageError(where, "item length", length, f"at most {len(body) - offset}")
            items.append(Item(ItemType(number), body[offset : offset + length]))
            offset += length
        return cls(epoch, seq, seq - behind, tuple(items))


@dataclass(frozen=True, slots=True)
class ShortAcknowledgement:
    """Acknowledgement in the opposite direction.

    Attributes:
        epoch: Epoch of the acknowledged messages.
        base: All sequence numbers below it were received (0..2^32 - 1).
        received: Further sequence numbers that were received, `base` + 1 to `base` + 255.
    """

    epoch: int
    base: int
    received: frozenset[int] = frozenset()

    def pack(self) -> bytes:
        """Return the bytes, at most 43.

        Raises:
            ShortMessageError: A number is out of range.
        """
        if not (0 <= self.epoch < 2**32 and 0 <= self.base < 2**32):
            raise ShortMessageError(_WHERE, "epoch and base", (self.epoch, self.base), "32 bits")
        bitmap = bytearray(WINDOW // 8)
        for seq in self.received:
            if not 0 <= seq - self.base < WINDOW:
                raise ShortMessageError(_WHERE, "received", seq, f"{self.base} to {self.base + WINDOW - 1}")
            bitmap[(seq - self.base) // 8] |= 0x80 >> (seq - self.base) % 8
        return _with_crc(_ACKNOWLEDGEMENT.pack(_ACKNOWLEDGEMENT_TYPE, self.epoch, self.base) + bitmap.rstrip(b"\0"))

    @classmethod
    def unpack(cls, data: bytes, where: str = _WHERE) -> "ShortAcknowledgement":
        """Parse an acknowledgement.

        Raises:
            ShortMessageError: It is not a valid one.
        """
        body = _without_crc(data, _ACKNOWLEDGEMENT.size, MAX_ACKNOWLEDGEMENT_BYTES, where)
        message_type, epoch, base = _ACKNOWLEDGEMENT.unpack_from(body)
        if message_type != _ACKNOWLEDGEMENT_TYPE:
            raise ShortMessageError(where, "type", message_type, f"{_ACKNOWLEDGEMENT_TYPE:#x}")
        bitmap = body[_ACKNOWLEDGEMENT.size :]
        received = frozenset(base + n for n in range(len(bitmap) * 8) if bitmap[n // 8] & 0x80 >> n % 8)
        return cls(epoch, base, received)


def pack_contact(image: ReceivedImage) -> bytes:
    """Return the content of a contact item; its tail is as much of the preview as one message holds.

    The content can be cut anywhere from `contact_head_bytes` on: this shortens the preview.

    Raises:
        ShortMessageError: A value does not fit the format.
    """
    preview_end = image.missing[0][0] if image.missing else len(image.stream)
    flags = _COMPLETE_BIT if image.complete else 0
    flags |= _AUTHENTICATED.index(image.authenticated) << _AUTHENTICATED_SHIFT
    record = b""
    if image.contact is not None:
        flags |= _RECORD_BIT
        record = summary_of(image.contact, image.height_px, image.width_px).pack()
    try:
        head = _CONTACT.pack(
            int(image.image_id, 36).to_bytes(3, "big"),
            image.version,
            image.first_frame_utc_s,
            image.last_frame_utc_s,
            flags,
            image.bytes_received.to_bytes(3, "big"),
            image.bytes_total.to_bytes(3, "big"),
            len(image.stream).to_bytes(3, "big"),
            min(image.frames_received, 0xFFFF),
        )
    except (struct.error, OverflowError) as error:
        raise ShortMessageError(_WHERE, "contact", image.image_id, f"values that fit the format: {error}") from error
    name = image.vehicle_id.encode()
    content = bytes([len(name)]) + name + head + record
    return content + image.stream[:preview_end][: MAX_ITEM_BYTES - len(content)]


def contact_head_bytes(content: bytes) -> int:
    """Return the number of bytes of a contact item before its preview."""
    before_flags = 1 + content[0]
    flags = content[before_flags + 23]
    return before_flags + _CONTACT.size + (RECORD_SIZE if flags & _RECORD_BIT else 0)


def unpack_contact(content: bytes, vessel_id: str, where: str = _WHERE) -> ReceivedImage:
    """Return the record of a contact item: the vessel's version of the image, with the preview only.

    What the message leaves out of the stream is in `missing`.

    Raises:
        BadInputError: The content is not valid.
    """
    if not content or len(content) < 1 + content[0] + _CONTACT.size or len(content) < contact_head_bytes(content):
        raise ShortMessageError(where, "contact", len(content), "a complete contact item")
    name = content[1 : 1 + content[0]].decode("ascii", "replace")
    image_id, version, first_s, last_s, flags, received, total, stream, frames = _CONTACT.unpack_from(
        content, 1 + content[0]
    )
    if flags >> _AUTHENTICATED_SHIFT >= len(_AUTHENTICATED):
        raise ShortMessageError(where, "flags", flags, "0 to 11")
    head_bytes = contact_head_bytes(content)
    preview, stream_bytes = content[head_bytes:], int.from_bytes(stream, "big")
    if len(preview) > stream_bytes or not math.isfinite(first_s) or not math.isfinite(last_s):
        raise ShortMessageError(where, "contact", len(preview), "a preview within the stream, and finite times")
    summary = ContactSummary.unpack(content[head_bytes - RECORD_SIZE : head_bytes], where) if flags & 1 else None
    cut = len(preview) < stream_bytes
    update = ImageUpdate(
        source=0,
        image_id=_image_id(int.from_bytes(image_id, "big")),
        version=version,
        contact=summary,
        # Without its first byte a stream has no header, and cannot be decoded.
        stream=preview.ljust(stream_bytes, b"\0") if preview else b"",
        missing=((len(preview), stream_bytes),) if preview and cut else (),
        complete=bool(flags & _COMPLETE_BIT) and not cut,
        received_bytes=min(int.from_bytes(received, "big"), len(preview)),
        total_bytes=int.from_bytes(total, "big"),
        frames=frames,
        conflicts=0,
        first_frame_s=first_s,
        last_frame_s=last_s,
    )
    try:
        return received_image(update, vessel_id, name, authenticated=_AUTHENTICATED[flags >> _AUTHENTICATED_SHIFT])
    except ValueError as error:  # of pydantic
        raise ShortMessageError(where, "contact", name, f"a valid record: {error}") from error


def pack_decision(decision: Decision) -> bytes:
    """Return the content of a decision item: all fields, so that the shore site stores the same record."""
    fields = decision.model_dump()
    packed: bytes = msgpack.packb([fields[name] for name in _DECISION_FIELDS])
    return packed


def unpack_decision(content: bytes, vessel_id: str, where: str = _WHERE) -> Decision:
    """Return the record of a decision item.

    Raises:
        BadInputError: The content is not valid.
    """
    try:
        values = msgpack.unpackb(content, raw=False, use_list=False)
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise PayloadError(where, "decision", content[:40], "a msgpack array") from error
    if not isinstance(values, tuple) or len(values) != len(_DECISION_FIELDS):
        raise PayloadError(where, "decision", values, f"an array of {len(_DECISION_FIELDS)} values")
    fields = dict(zip(_DECISION_FIELDS, values, strict=True))
    return validated(Decision, fields | {"vessel_id": vessel_id}, where)


def decision_fragments(content: bytes, record_number: int) -> list[Item]:
    """Return a decision as one item, or as fragments if it does not fit a message.

    Raises:
        ShortMessageError: It is longer than 255 fragments.
    """
    if len(content) <= MAX_ITEM_BYTES:
        return [Item(ItemType.DECISION, content)]
    parts = [content[start : start + FRAGMENT_BYTES] for start in range(0, len(content), FRAGMENT_BYTES)]
    if len(parts) > MAX_FRAGMENTS:
        raise ShortMessageError(_WHERE, "decision", len(content), f"at most {MAX_FRAGMENTS * FRAGMENT_BYTES} bytes")
    heads = (_FRAGMENT.pack(record_number, index, len(parts)) for index in range(len(parts)))
    return [Item(ItemType.DECISION_FRAGMENT, head + part) for head, part in zip(heads, parts, strict=True)]


def fragment(content: bytes, where: str = _WHERE) -> tuple[int, int, int, bytes]:
    """Return record number, index, count and data of a fragment.

    Raises:
        ShortMessageError: It is not a valid one.
    """
    if len(content) <= _FRAGMENT.size:
        raise ShortMessageError(where, "fragment", len(content), f"more than {_FRAGMENT.size} bytes")
    number, index, count = _FRAGMENT.unpack_from(content)
    if index >= count:
        raise ShortMessageError(where, "fragment index", index, f"below {count}")
    return number, index, count, content[_FRAGMENT.size :]


def items_bytes(items: Sequence[Item]) -> int:
    """Return the length of a message with these items."""
    return HEAD_BYTES + sum(ITEM_HEAD_BYTES + len(item.content) for item in items)


def _image_id(number: int) -> str:
    if number >= IMAGE_ID_COUNT:
        raise ShortMessageError(_WHERE, "image_id", number, f"below {IMAGE_ID_COUNT}")
    return format_image_id(number)


def _with_crc(body: bytes) -> bytes:
    return body + binascii.crc_hqx(body, 0xFFFF).to_bytes(_CRC_BYTES, "big")


def _without_crc(data: bytes, min_body_bytes: int, max_bytes: int, where: str) -> bytes:
    if not min_body_bytes + _CRC_BYTES <= len(data) <= max_bytes:
        raise ShortMessageError(where, "length", len(data), f"{min_body_bytes + _CRC_BYTES} to {max_bytes} bytes")
    body, crc = data[:-_CRC_BYTES], data[-_CRC_BYTES:]
    if binascii.crc_hqx(body, 0xFFFF).to_bytes(_CRC_BYTES, "big") != crc:
        raise ShortMessageError(where, "CRC", crc.hex(), "the CRC of the bytes before it")
    return body
