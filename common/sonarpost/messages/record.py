"""Base of every record, and the types of fields."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

PlatformId = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")]
ImageId = Annotated[str, Field(pattern=r"^[0-9A-Z]{4}$")]
Text = Annotated[str, Field(max_length=2000)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ModelId = Annotated[str, Field(pattern=r"^([0-9a-f]{32})?$")]
Crc32 = Annotated[int, Field(ge=0, le=0xFFFF_FFFF)]
ModelHash = Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")]
Time = Annotated[float, Field(ge=0, le=253402300799)]
Metres = Annotated[float, Field(ge=0, le=20000)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Address = Annotated[int, Field(ge=0, le=255)]
RateNumber = Annotated[int, Field(ge=0, le=255)]
# Not every language has unsigned integers of 64 bits.
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
Ordinal = Annotated[int, Field(ge=1, le=2**63 - 1)]
# Becomes part of file names, so its characters and its length are bounded.
RecordId = Annotated[str, Field(pattern=r"^[!-~]{1,64}$")]

Channel = Literal["port", "starboard"]
Verdict = Literal["mine_like", "not_mine_like", "unsure"]
CommandKind = Literal["refine", "resend", "revisit", "expand", "original", "region", "prioritise"]
QueuePlace = Literal["first", "last"]
BoxStart = Annotated[int, Field(ge=0, le=31)]
BoxEnd = Annotated[int, Field(ge=1, le=32)]
TaskingKind = Literal["comment", "command"]
AtdClass = Literal["mine_like", "clutter", "structure"]
DeliveryState = Literal["waiting", "delivered", "refused"]
DownlinkKind = Literal["refine", "resend", "revisit", "decision", "expand", "original", "region", "prioritise"]
DownlinkStep = Literal["asked", "sent", "confirmed", "refused", "expired"]
ServiceState = Literal["starting", "ok", "degraded", "stopping"]


class Record(BaseModel):
    """Base of every record: frozen, strictly typed, unknown fields ignored (a newer minor version adds fields)."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)

    TYPE: ClassVar[str] = ""
    VERSION: ClassVar[int] = 1
    # Whether the wire omits fields with their default value; for records of thin links.
    SPARSE: ClassVar[bool] = False
