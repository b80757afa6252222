"""Records of the review: decisions, commands, comments."""

from __future__ import annotations

from typing import Annotated, ClassVar, Final

from pydantic import Field, ValidationInfo, field_validator

from sonarpost.messages.record import (
    BoxEnd,
    BoxStart,
    CommandKind,
    DeliveryState,
    Fraction,
    ImageId,
    Latitude,
    Longitude,
    Ordinal,
    PlatformId,
    QueuePlace,
    Record,
    RecordId,
    TaskingKind,
    Text,
    Time,
    Verdict,
)

MAX_OVERRULED: Final = 16
"""Decisions that one decision can overrule."""

MIN_REGION_BYTES: Final = 24
"""Shortest stream of a region."""

_IMAGE_OF_COMMAND: Final = {
    "refine": "the image to refine",
    "resend": "the image to resend",
    "expand": "the image to show more around",
    "original": "the image to send without despeckling",
    "region": "the image with the region",
    "prioritise": "the image to move in the queue",
}
"""The image that each kind of command names, for error messages."""


class Decision(Record):
    """An operator's verdict on one image.

    Attributes:
        decision_id: Unique; a repeated decision is recognised by it.
        vessel_id: Vessel of the operator; must be the vessel of the key.
        vehicle_id: Vehicle of the image.
        image_id: Identifier of the image.
        image_version: Version that the operator saw.
        verdict: The verdict.
        confidence: The operator's confidence. None if not given.
        mlo_class: Class of mine-like object. None if not classified.
        remark: Free text.
        operator: Name of the operator.
        decided_utc_s: Time of the decision.
        withdraws: Decision on the same image that this record takes back; it repeats the verdict before that one,
            `unsure` if there was none. None if the record is a decision.
        overrules: Decisions of other operators on the same image that this one replaces.
    """

    TYPE: ClassVar[str] = "decision"

    decision_id: RecordId
    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    image_version: Ordinal
    verdict: Verdict
    confidence: Fraction | None = None
    mlo_class: Annotated[str, Field(max_length=60)] | None = None
    remark: Text = ""
    operator: Annotated[str, Field(min_length=1, max_length=120)]
    decided_utc_s: Time
    withdraws: RecordId | None = None
    overrules: Annotated[tuple[RecordId, ...], Field(max_length=MAX_OVERRULED)] = ()


class Command(Record):
    """A request of the vessel, or of the shore site through it, to a vehicle.

    Attributes:
        command_id: Unique; a repeated command is recognised by it.
        kind: refine: more detail. resend: the same again. expand: more seabed around the contact, as an image of its
            own. original: the contact without despeckling, as an image of its own. region: a part of the image, as an
            image of its own. prioritise: send the rest of the image before or after all others. revisit: survey a
            position again.
        vehicle_id: Vehicle that receives it.
        image_id: Image of the request; None only for `revisit`.
        lat_deg: Position to revisit. None for the other kinds.
        lon_deg: Position to revisit. None for the other kinds.
        issued_by: Name of the person.
        issued_utc_s: Time of the command.
        box: With `region`: top, left, bottom and right of the region in 1/32 of the sides of the image.
        stream_bytes: With `region`: length of the stream of the region. None for the other kinds.
        place: With `prioritise`: place in the transmit queue. None for the other kinds.
    """

    TYPE: ClassVar[str] = "command"

    command_id: RecordId
    kind: CommandKind
    vehicle_id: PlatformId
    image_id: Annotated[ImageId | None, Field(validate_default=True)] = None
    lat_deg: Annotated[Latitude | None, Field(validate_default=True)] = None
    lon_deg: Annotated[Longitude | None, Field(validate_default=True)] = None
    issued_by: Annotated[str, Field(min_length=1, max_length=120)]
    issued_utc_s: Time
    box: Annotated[tuple[BoxStart, BoxStart, BoxEnd, BoxEnd] | None, Field(validate_default=True)] = None
    stream_bytes: Annotated[int | None, Field(ge=MIN_REGION_BYTES, le=65535, validate_default=True)] = None
    place: Annotated[QueuePlace | None, Field(validate_default=True)] = None

    @field_validator("image_id")
    @classmethod
    def _check_image_id(cls, image_id: str | None, info: ValidationInfo) -> str | None:
        kind = info.data.get("kind")
        if image_id is None and kind in _IMAGE_OF_COMMAND:
            raise ValueError(_IMAGE_OF_COMMAND[kind])
        return image_id

    @field_validator("lat_deg", "lon_deg")
    @classmethod
    def _check_position(cls, degrees: float | None, info: ValidationInfo) -> float | None:
        if degrees is None and info.data.get("kind") == "revisit":
            raise ValueError("the position to revisit")
        return degrees

    @field_validator("box")
    @classmethod
    def _check_box(
        cls, box: tuple[int, int, int, int] | None, info: ValidationInfo
    ) -> tuple[int, int, int, int] | None:
        if box is None and info.data.get("kind") == "region":
            raise ValueError("the edges of the region")
        if box is not None and not (box[0] < box[2] and box[1] < box[3]):
            raise ValueError("bottom and right behind top and left")
        return box

    @field_validator("stream_bytes")
    @classmethod
    def _check_stream_bytes(cls, stream_bytes: int | None, info: ValidationInfo) -> int | None:
        if stream_bytes is None and info.data.get("kind") == "region":
            raise ValueError("the length of the region's stream")
        return stream_bytes

    @field_validator("place")
    @classmethod
    def _check_place(cls, place: str | None, info: ValidationInfo) -> str | None:
        if place is None and info.data.get("kind") == "prioritise":
            raise ValueError("first or last")
        return place


class Comment(Record):
    """An expert's comment from the shore site on one image, for the operator on the vessel.

    Attributes:
        comment_id: Unique; a repeated comment is recognised by it.
        vessel_id: Vessel of the operator; must be the vessel of the key.
        vehicle_id: Vehicle of the image.
        image_id: Identifier of the image.
        image_version: Version that the expert saw.
        verdict: The verdict. None if none is given.
        confidence: The expert's confidence. None if not given.
        mlo_class: Class of mine-like object. None if not classified.
        remark: Free text.
        author: Name of the expert.
        commented_utc_s: Time of the comment.
    """

    TYPE: ClassVar[str] = "comment"

    comment_id: RecordId
    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    image_version: Ordinal
    verdict: Verdict | None = None
    confidence: Fraction | None = None
    mlo_class: Annotated[str, Field(max_length=60)] | None = None
    remark: Text = ""
    author: Annotated[str, Field(min_length=1, max_length=120)]
    commented_utc_s: Time


class TaskingState(Record):
    """Progress of a comment or a command from the shore site to a vessel. c2 publishes it at every change.

    Attributes:
        vessel_id: Vessel that it is for.
        kind: Which record.
        record_id: Its `comment_id` or `command_id`.
        state: waiting: stored by c2. delivered: stored by the vessel's relay. refused: the relay does not accept it.
        reason: With `refused`: the relay's reason.
        changed_utc_s: Time of this change.
    """

    TYPE: ClassVar[str] = "tasking_state"

    vessel_id: PlatformId
    kind: TaskingKind
    record_id: RecordId
    state: DeliveryState
    reason: Text = ""
    changed_utc_s: Time
