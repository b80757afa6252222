"""The records that services exchange over Zenoh.

A record is validated when it is constructed. On the wire it is a plain msgpack map with two more fields, `type` and `v`
(see `sonarpost.wire`). `docs/specifications/zenoh.md` specifies the same for other languages. A value that is not known
is None. Times are seconds since 1970-01-01 UTC.
"""

from __future__ import annotations

from sonarpost.messages.acoustic import (
    MAX_TRANSMISSION_S,
    AcousticFrame,
    DownlinkState,
    OutgoingMessage,
    QueuedImage,
    QueueState,
    ReceivedMessage,
    Transmission,
    Transmissions,
)
from sonarpost.messages.contact import PROBABILITY_TOLERANCE, Contact, Pixels, Snippet
from sonarpost.messages.image import (
    CodedImage,
    EncodedImage,
    ImagePart,
    LinkQuality,
    ReceivedImage,
    ReconstructedImage,
)
from sonarpost.messages.record import (
    Address,
    AtdClass,
    BoxEnd,
    BoxStart,
    CommandKind,
    Count,
    DeliveryState,
    DownlinkStep,
    Fraction,
    ImageId,
    Latitude,
    Longitude,
    Ordinal,
    PlatformId,
    QueuePlace,
    RateNumber,
    Record,
    ServiceState,
    Sha256,
    TaskingKind,
    Text,
    Time,
    Verdict,
)
from sonarpost.messages.review import MIN_REGION_BYTES, Command, Comment, Decision, TaskingState
from sonarpost.messages.service import Health, Relayed
from sonarpost.messages.vehicle import ReceivedStatus, VehicleRange, VehicleStatus

__all__ = [
    "MAX_TRANSMISSION_S",
    "MIN_REGION_BYTES",
    "PROBABILITY_TOLERANCE",
    "AcousticFrame",
    "Address",
    "AtdClass",
    "BoxEnd",
    "BoxStart",
    "CodedImage",
    "Command",
    "CommandKind",
    "Comment",
    "Contact",
    "Count",
    "Decision",
    "DeliveryState",
    "DownlinkState",
    "DownlinkStep",
    "EncodedImage",
    "Fraction",
    "Health",
    "ImageId",
    "ImagePart",
    "Latitude",
    "LinkQuality",
    "Longitude",
    "Ordinal",
    "OutgoingMessage",
    "Pixels",
    "PlatformId",
    "QueuePlace",
    "QueueState",
    "QueuedImage",
    "RateNumber",
    "ReceivedImage",
    "ReceivedMessage",
    "ReceivedStatus",
    "ReconstructedImage",
    "Record",
    "Relayed",
    "ServiceState",
    "Sha256",
    "Snippet",
    "TaskingKind",
    "TaskingState",
    "Text",
    "Time",
    "Transmission",
    "Transmissions",
    "VehicleRange",
    "VehicleStatus",
    "Verdict",
]
