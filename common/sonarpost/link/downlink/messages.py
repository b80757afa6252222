"""Contents of `v1` messages: commands, decisions, their confirmations, the vehicle's status, data of its programs.

The first byte of a message is its kind. Everything but data fits the 27 bytes that a message has in a frame of 32.
docs/specifications/link-messages.md specifies the bytes.

A command (or decision) has a token of 32 bits. The vehicle deduplicates commands by token and content, and confirms
every copy. So a lost command or confirmation does not change the outcome.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, Final, Literal

from typing_extensions import override

from sonarpost.codec.region import PACKED_BYTES, RegionBox
from sonarpost.errors import BadInputError, FrameError
from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.link.frames.paper.frame import format_image_id, is_image_id
from sonarpost.link.frames.v1.payload_objects import MAX_NUMBER, MAX_STREAM_BYTES, ImageNumber, StreamPosition
from sonarpost.link.state import Bounds, check_bounds
from sonarpost.messages import MIN_REGION_BYTES, QueuePlace, Verdict

SMALLEST_ROOM_BYTES: Final = 27
"""Length of a message in a frame of 32 bytes without a tag."""
ALL_BYTES: Final = 0
"""Value of `RefineMessage.stream_bytes`: as much of the image as the vehicle has."""

_WHERE: Final = "acoustic message"
_MAX_U32: Final = 2**32 - 1

_DEGREE_STEPS: Final = 10_000_000
_CONFIDENCE_STEPS: Final = 254
_NO_CONFIDENCE: Final = 255
_MAX_VERSION: Final = 255

_HEAD = struct.Struct(">BII")
_OUTCOME = struct.Struct(">IB")


class MessageKind(IntEnum):
    """The first byte of a message."""

    REFINE = 0x01
    RESEND = 0x02
    REVISIT = 0x03
    DECISION = 0x04
    EXPAND = 0x05
    ORIGINAL = 0x06
    REGION = 0x07
    CONFIRMATION = 0x08
    PRIORITISE = 0x09
    DATA = 0x10
    STATUS = 0x11


class CommandOutcome(IntEnum):
    """The vehicle's answer to a command.

    ACCEPTED: it is stored on the vehicle, and its consumers receive it.
    UNKNOWN_IMAGE: the vehicle does not have this image any more.
    UNSUPPORTED: the vehicle has no consumer for such commands.
    """

    ACCEPTED = 0
    UNKNOWN_IMAGE = 1
    UNSUPPORTED = 2


_PLACES: Final[tuple[QueuePlace, ...]] = ("first", "last")
_VERDICTS: Final[tuple[Verdict, ...]] = ("mine_like", "not_mine_like", "unsure")


@dataclass(frozen=True, slots=True)
class CommandMessage:
    """Base of all commands.

    Attributes:
        token: 0..2^32-1, see `token_of`.
        issued_utc_s: When it was issued, whole seconds since 1970-01-01 UTC, to 2106.

    Raises:
        FrameError: A value out of range (also in the derived classes).
    """

    token: Annotated[int, Bounds(0, _MAX_U32)]
    issued_utc_s: Annotated[int, Bounds(0, _MAX_U32)]

    def __post_init__(self) -> None:
        check_bounds(self, _WHERE, FrameError)


@dataclass(frozen=True, slots=True)
class ImageCommandMessage(CommandMessage):
    """Base of the commands for an image. `number`: of its contact, 1..65535."""

    number: ImageNumber


@dataclass(frozen=True, slots=True)
class RefineMessage(ImageCommandMessage):
    """Send more detail. `stream_bytes`: length of the stream to send, 1..65535; `ALL_BYTES` for all."""

    stream_bytes: StreamPosition = ALL_BYTES


@dataclass(frozen=True, slots=True)
class ResendMessage(ImageCommandMessage):
    """Send the image again, from its beginning."""


@dataclass(frozen=True, slots=True)
class ExpandMessage(ImageCommandMessage):
    """Send more of the seabed around the contact, as a new image."""


@dataclass(frozen=True, slots=True)
class OriginalMessage(ImageCommandMessage):
    """Send the contact without despeckling, as a new image."""


@dataclass(frozen=True, slots=True)
class RegionMessage(ImageCommandMessage):
    """Send a part of the image, as a new image.

    Attributes:
        box: The part.
        stream_bytes: Length of the new image's stream.
    """

    box: RegionBox
    stream_bytes: Annotated[int, Bounds(MIN_REGION_BYTES, MAX_STREAM_BYTES)]


@dataclass(frozen=True, slots=True)
class PrioritiseMessage(ImageCommandMessage):
    """Send the rest of the image before or after all others. `place`: first or last."""

    place: QueuePlace

    @override
    def __post_init__(self) -> None:
        ImageCommandMessage.__post_init__(self)
        if self.place not in _PLACES:
            raise FrameError(_WHERE, "place", self.place, ", ".join(_PLACES))


@dataclass(frozen=True, slots=True)
class RevisitMessage(CommandMessage):
    """Survey a position again.

    Attributes:
        lat_deg: WGS 84, -90..90; sent in steps of 1e-7 degree.
        lon_deg: WGS 84, -180..180; the same.
    """

    lat_deg: Annotated[float, Bounds(-90, 90)]
    lon_deg: Annotated[float, Bounds(-180, 180)]


@dataclass(frozen=True, slots=True)
class DecisionMessage(ImageCommandMessage):
    """An operator's verdict on a contact. The comment and the operator's name are not sent.

    Attributes:
        version: Version of the image, from 1; sent as 255 if above 254.
        verdict: The verdict.
        confidence: 0..1 in steps of 1/254, None if not given.
        mlo_class: Class of mine-like object, empty if not classified. Cut between characters if it does not fit.
    """

    version: Annotated[int, Bounds(1, 2**63)]
    verdict: Verdict
    confidence: Annotated[float, Bounds(0, 1)] | None = None
    mlo_class: str = ""

    @override
    def __post_init__(self) -> None:
        ImageCommandMessage.__post_init__(self)
        if self.verdict not in _VERDICTS:
            raise FrameError(_WHERE, "verdict", self.verdict, ", ".join(_VERDICTS))

    @property
    def is_final(self) -> bool:
        """Whether the verdict stops the rest of the image; `unsure` queues it again."""
        return self.verdict != "unsure"


@dataclass(frozen=True, slots=True)
class ConfirmationMessage:
    """Outcomes of commands. `outcomes`: token and outcome of each, at least one."""

    outcomes: tuple[tuple[int, CommandOutcome], ...]

    def __post_init__(self) -> None:
        _check("outcomes", len(self.outcomes), 1, 800)
        for token, _ in self.outcomes:
            _check("token", token, 0, _MAX_U32)


@dataclass(frozen=True, slots=True)
class DataMessage:
    """Data of a program. `data`: at least one byte."""

    data: bytes

    def __post_init__(self) -> None:
        _check("data", len(self.data), 1, 4095)


DownlinkCommand = (
    RefineMessage
    | ResendMessage
    | RevisitMessage
    | DecisionMessage
    | ExpandMessage
    | OriginalMessage
    | RegionMessage
    | PrioritiseMessage
)
DownlinkContent = DownlinkCommand | ConfirmationMessage | DataMessage | StatusMessage

_FORMS: Final[Mapping[MessageKind, tuple[type[DownlinkCommand], struct.Struct]]] = {
    MessageKind.REFINE: (RefineMessage, struct.Struct(">HH")),
    MessageKind.RESEND: (ResendMessage, struct.Struct(">H")),
    MessageKind.REVISIT: (RevisitMessage, struct.Struct(">ii")),
    MessageKind.DECISION: (DecisionMessage, struct.Struct(">HBBB")),
    MessageKind.EXPAND: (ExpandMessage, struct.Struct(">H")),
    MessageKind.ORIGINAL: (OriginalMessage, struct.Struct(">H")),
    MessageKind.REGION: (RegionMessage, struct.Struct(f">H{PACKED_BYTES}sH")),
    MessageKind.PRIORITISE: (PrioritiseMessage, struct.Struct(">HB")),
}
"""Class of each command, and the layout of what follows its head; a decision ends with the text of its class."""
_KINDS: Final = {command: kind for kind, (command, _) in _FORMS.items()}


def pack(content: DownlinkContent, room_bytes: int = SMALLEST_ROOM_BYTES) -> bytes:
    """Return the bytes of a message.

    Args:
        content: The content.
        room_bytes: Maximum length; the class in a decision is cut to it.

    Raises:
        FrameError: It does not fit.
    """
    packed = _packed(content, room_bytes)
    if len(packed) > room_bytes and not isinstance(content, DataMessage):
        raise FrameError(_WHERE, "length", len(packed), f"at most {room_bytes} bytes")
    return packed


def _packed(content: DownlinkContent, room_bytes: int) -> bytes:
    match content:
        case DataMessage():
            return bytes([MessageKind.DATA]) + content.data
        case StatusMessage():
            return bytes([MessageKind.STATUS]) + content.pack()
        case ConfirmationMessage():
            return bytes([MessageKind.CONFIRMATION]) + b"".join(_OUTCOME.pack(*each) for each in content.outcomes)
        case _:
            kind = _KINDS[type(content)]
            fixed = _HEAD.pack(kind, content.token, content.issued_utc_s) + _FORMS[kind][1].pack(*_values(content))
            text = content.mlo_class if isinstance(content, DecisionMessage) else ""
            return fixed + _shortened(text, room_bytes - len(fixed))


def _values(command: DownlinkCommand) -> tuple[int | bytes, ...]:
    """Return the fields of a command after its head, as they are sent."""
    match command:
        case RevisitMessage():
            return round(command.lat_deg * _DEGREE_STEPS), round(command.lon_deg * _DEGREE_STEPS)
        case DecisionMessage():
            confidence = _NO_CONFIDENCE if command.confidence is None else round(command.confidence * _CONFIDENCE_STEPS)
            version = min(command.version, _MAX_VERSION)
            return command.number, version, _VERDICTS.index(command.verdict), confidence
        case RefineMessage():
            return command.number, command.stream_bytes
        case RegionMessage():
            return command.number, command.box.pack(), command.stream_bytes
        case PrioritiseMessage():
            return command.number, _PLACES.index(command.place)
        case _:
            return (command.number,)


def _shortened(text: str, max_bytes: int) -> bytes:
    return text.encode()[: max(0, max_bytes)].decode(errors="ignore").encode()


def unpack(data: bytes, where: str = _WHERE) -> DownlinkContent:
    """Parse the bytes of a message.

    Raises:
        FrameError: An unknown kind, a wrong length, or a value out of range.
    """
    try:
        return _content(data)
    except FrameError as error:
        raise FrameError(where, error.field, error.value, error.expected) from error


def _content(data: bytes) -> DownlinkContent:
    kind, body = data[0] if data else -1, data[1:]
    if kind == MessageKind.DATA:
        return DataMessage(body)
    if kind == MessageKind.STATUS:
        return StatusMessage.unpack(body)
    if kind == MessageKind.CONFIRMATION:
        return _confirmation(body)
    if kind not in _FORMS:
        raise FrameError(_WHERE, "kind", kind, ", ".join(f"{int(known):#04x}" for known in MessageKind))
    if len(data) < _HEAD.size:
        raise FrameError(_WHERE, "length", len(data), f"at least {_HEAD.size} bytes")
    _, token, issued = _HEAD.unpack_from(data)
    return _command(MessageKind(kind), token, issued, data[_HEAD.size :])


def _command(kind: MessageKind, token: int, issued: int, body: bytes) -> DownlinkCommand:
    command, layout = _FORMS[kind]
    text = b""
    if kind == MessageKind.DECISION:
        body, text = body[: layout.size], body[layout.size :]
    if len(body) != layout.size:
        raise FrameError(_WHERE, "length", len(body), f"{layout.size} bytes after the head")
    values: Sequence[Any] = layout.unpack(body)
    if kind == MessageKind.REGION:
        values = values[0], _box(values[1]), values[2]
    elif kind == MessageKind.PRIORITISE:
        values = values[0], _named(_PLACES, "place", values[1])
    elif kind == MessageKind.REVISIT:
        values = [value / _DEGREE_STEPS for value in values]
    elif kind == MessageKind.DECISION:
        number, version, verdict, confidence = values
        probability = None if confidence == _NO_CONFIDENCE else confidence / _CONFIDENCE_STEPS
        values = number, version, _named(_VERDICTS, "verdict", verdict), probability, _class_name(text)
    return command(token, issued, *values)


def _named(names: Sequence[str], field: str, place: int) -> str:
    if place >= len(names):
        raise FrameError(_WHERE, field, place, f"0..{len(names) - 1}")
    return names[place]


def _class_name(text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError as error:
        raise FrameError(_WHERE, "mlo_class", text, "UTF-8") from error


def _box(packed: bytes) -> RegionBox:
    try:
        return RegionBox.unpack(packed)
    except BadInputError as error:
        raise FrameError(_WHERE, "box", packed, error.expected) from error


def _confirmation(body: bytes) -> ConfirmationMessage:
    if not body or len(body) % _OUTCOME.size:
        raise FrameError(_WHERE, "length", len(body), f"a multiple of {_OUTCOME.size} bytes after the kind")
    found: list[tuple[int, CommandOutcome]] = []
    for token, outcome in _OUTCOME.iter_unpack(body):
        if outcome not in tuple(CommandOutcome):
            raise FrameError(_WHERE, "outcome", outcome, "0..2")
        found.append((token, CommandOutcome(outcome)))
    return ConfirmationMessage(tuple(found))


def confirmations(outcomes: Sequence[tuple[int, CommandOutcome]]) -> tuple[ConfirmationMessage, ...]:
    """Return outcomes as messages of at most `SMALLEST_ROOM_BYTES` each, as few as possible."""
    each = (SMALLEST_ROOM_BYTES - 1) // _OUTCOME.size
    return tuple(ConfirmationMessage(tuple(outcomes[at : at + each])) for at in range(0, len(outcomes), each))


def token_of(record_id: str, kind: Literal["command", "decision"], attempt: int = 0) -> int:
    """Return the token of a record: always the same, so that a repeated record is one command.

    Args:
        record_id: Its `command_id` or `decision_id`.
        kind: Which of them.
        attempt: Incremented by a sender if another record has the token.
    """
    digest = hashlib.sha256(f"{kind}\0{record_id}\0{attempt}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def record_id_of(source: int, token: int) -> str:
    """Return the identifier of a command on the vehicle: the sender's modem address and the token."""
    return f"a{source}-{token:08x}"


def number_of_image(image_id: str) -> int:
    """Return the contact number, 1..65535, of an image identifier.

    Identifiers count to 36^4, contact numbers to 65535. `image_of_number` is the inverse for identifiers from 0001 to
    1EKF.

    Raises:
        FrameError: Not a valid identifier.
    """
    if not is_image_id(image_id):
        raise FrameError(_WHERE, "image_id", image_id, "four of 0-9 and A-Z")
    return (int(image_id, 36) - 1) % MAX_NUMBER + 1


def image_of_number(number: int) -> str:
    """Return the image identifier of a contact number: four digits to the base 36, 0001 to 1EKF.

    Raises:
        FrameError: Not 1..65535.
    """
    _check("number", number, 1, MAX_NUMBER)
    return format_image_id(number)


def _check(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise FrameError(_WHERE, name, value, f"{low}..{high}")
