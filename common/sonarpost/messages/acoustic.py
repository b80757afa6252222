"""Records of the acoustic link: frames, messages, queue, transmissions, progress of commands."""

from __future__ import annotations

from typing import Annotated, ClassVar, Final, Literal

from pydantic import Field, ValidationInfo, field_validator

from sonarpost.messages.image import LinkQuality
from sonarpost.messages.record import (
    Address,
    Count,
    DownlinkKind,
    DownlinkStep,
    Fraction,
    ImageId,
    PlatformId,
    RateNumber,
    Record,
    RecordId,
    Text,
    Time,
)

MAX_TRANSMISSION_S: Final = 300.0
"""Longer than any transmission of a modem; a longer one in a record means damage."""


class AcousticFrame(Record):
    """One frame that a modem transmitted (`tx`) or received (`rx`).

    Attributes:
        direction: Transmitted or received.
        platform_id: Platform of the modem.
        time_utc_s: End of the packet by that platform's clock.
        source: Address of the transmitting modem.
        destination: Address that it was sent to; the driver of the modem has an address for all modems, or none.
        rate: Number of the rate, see the driver of the modem. None if the modem did not report it.
        packet: Number of the packet on that platform.
        frame_number: Number of the frame within its packet.
        frame_count: Frames of the packet. None if the modem did not report it.
        data: Content of the frame, padding included.
        quality: Measurements of the packet. None if there are none.
        airtime_s: Nominal duration of the packet. None if the rate is not known.
    """

    TYPE: ClassVar[str] = "acoustic_frame"
    VERSION: ClassVar[int] = 2

    direction: Literal["tx", "rx"]
    platform_id: PlatformId
    time_utc_s: Time
    source: Address
    destination: Address
    rate: RateNumber | None
    packet: Count
    frame_number: Annotated[int, Field(ge=1, le=255)]
    frame_count: Annotated[int, Field(ge=0, le=255)] | None
    data: Annotated[bytes, Field(max_length=2048)]
    quality: LinkQuality | None = None
    airtime_s: Annotated[float, Field(gt=0, le=600)] | None = None


class OutgoingMessage(Record):
    """Other data that a program of the vehicle sends over the acoustic link, for example vehicle status.

    uuv_modem sends it with the `v1` wire format only.

    Attributes:
        message_id: Identifier given by the source. A message whose identifier was used before is not sent again.
        source: Program that sends it. Programs of one priority share the channel evenly.
        priority: 1 is first, 7 last. 1 to 5 go before images; 6 and 7 fill free space in frames until they have waited
            long.
        lifetime_s: Time after `created_utc_s` after which the message is dropped.
        created_utc_s: When it was created.
        data: Content; transmitted unchanged.
    """

    TYPE: ClassVar[str] = "outgoing_message"

    message_id: RecordId
    source: Annotated[str, Field(min_length=1, max_length=40)]
    priority: Annotated[int, Field(ge=1, le=7)]
    lifetime_s: Annotated[float, Field(gt=0, le=604800)]
    created_utc_s: Time
    data: Annotated[bytes, Field(min_length=1, max_length=1024)]


class ReceivedMessage(Record):
    """A message of a vehicle's program as received on the vessel.

    Attributes:
        vessel_id: Vessel that received it.
        vehicle_id: Vehicle that sent it, identified by the address of its modem.
        received_utc_s: When it was received.
        data: Content, as its source on the vehicle gave it.
        authenticated: Whether its acoustic frames were authenticated with a key.
    """

    TYPE: ClassVar[str] = "received_message"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    received_utc_s: Time
    data: Annotated[bytes, Field(min_length=1, max_length=4096)]
    authenticated: bool


class QueuedImage(Record):
    """One image in the acoustic transmit queue.

    Attributes:
        image_id: Identifier of the image on the acoustic link.
        contact_id: Identifier of its contact.
        bytes_left: Bytes of frames still to be sent, redundancy included, by the present plan.
        preview_utc_s: When its contact record and preview are expected to be sent. None if they are.
        expected_utc_s: When all that is planned is expected to be sent.
    """

    TYPE: ClassVar[str] = "queued_image"

    image_id: ImageId
    contact_id: Annotated[str, Field(min_length=1, max_length=120)]
    bytes_left: Count
    preview_utc_s: Time | None
    expected_utc_s: Time


class QueueState(Record):
    """The transmit queue of a vehicle, published at intervals.

    Attributes:
        platform_id: The vehicle.
        time_utc_s: Time of this state.
        rate: Number of the rate in use, see the driver of the modem.
        frame_loss: Fraction of frames lost, from the receiver's feedback. None if not known.
        packet_interval_s: Time from one packet to the next, medium access included.
        messages_waiting: Messages not yet sent.
        message_bytes: Bytes of these messages.
        images_waiting: Images not yet sent.
        images: These images, the first to be finished first; at most 500.
        images_accepted: New images ever accepted from the compressor; None from programs that do not count them.
    """

    TYPE: ClassVar[str] = "queue_state"
    VERSION: ClassVar[int] = 2

    platform_id: PlatformId
    time_utc_s: Time
    rate: RateNumber
    frame_loss: Fraction | None
    packet_interval_s: Annotated[float, Field(ge=0, le=86400)]
    messages_waiting: Count
    message_bytes: Count
    images_waiting: Count
    images: Annotated[tuple[QueuedImage, ...], Field(max_length=500)]
    images_accepted: Count | None = None


class Transmission(Record):
    """One transmission of a modem.

    Attributes:
        start_utc_s: Start.
        end_utc_s: End, at most 300 s later; the nominal one while the transmission is in progress.
    """

    TYPE: ClassVar[str] = "transmission"

    start_utc_s: Time
    end_utc_s: Time

    @field_validator("end_utc_s")
    @classmethod
    def _check_end(cls, end_utc_s: float, info: ValidationInfo) -> float:
        start_utc_s = info.data.get("start_utc_s")
        if start_utc_s is not None and not start_utc_s <= end_utc_s <= start_utc_s + MAX_TRANSMISSION_S:
            raise ValueError(f"a time from start_utc_s to {MAX_TRANSMISSION_S:g} s later")
        return end_utc_s


class Transmissions(Record):
    """The latest transmissions of a vehicle's modem, published at the start and at the end of each.

    Attributes:
        platform_id: The vehicle.
        time_utc_s: Time of this record, by the clock that the transmissions are timed with.
        transmissions: Those of the last 30 minutes since uuv_modem has started, oldest first. One with the start of an
            earlier record replaces the earlier one.
    """

    TYPE: ClassVar[str] = "transmissions"

    platform_id: PlatformId
    time_utc_s: Time
    transmissions: Annotated[tuple[Transmission, ...], Field(max_length=1000)]


class DownlinkState(Record):
    """Progress of a command or decision on its way to a vehicle.

    Published at every change, and after a restart of op_modem for those that are still open.

    Attributes:
        vessel_id: Vessel that sends it.
        vehicle_id: Vehicle that it is for.
        kind: Kind of the command, or `decision`.
        record_id: Its `command_id` or `decision_id`.
        state: asked: stored on the vessel. sent: transmitted at least once. confirmed: stored on the vehicle. refused:
            the vehicle cannot do it. expired: not confirmed in time.
        times_sent: Number of transmissions.
        expires_utc_s: Time after which it is not repeated.
        changed_utc_s: Time of this change.
        reason: With `refused`: the vehicle's reason.
    """

    TYPE: ClassVar[str] = "downlink_state"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    kind: DownlinkKind
    record_id: RecordId
    state: DownlinkStep
    times_sent: Count
    expires_utc_s: Time
    changed_utc_s: Time
    reason: Text = ""
