"""Everything that travels on Zenoh, as frozen records.

A record is validated when it is made, so a record that exists is right. On the wire it is a plain msgpack map with
two fields more, `type` and `v` (see `sonarpost.wire`); `docs/specifications/zenoh.md` describes the same for other languages.
A value that is not known is None: nothing is ever guessed. Times are seconds since 1970-01-01 UTC.
"""

from __future__ import annotations

import hashlib
from typing import Annotated, ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator

from sonarpost.errors import BadInputError

PlatformId = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")]
ImageId = Annotated[str, Field(pattern=r"^[0-9A-Z]{4}$")]
Text = Annotated[str, Field(max_length=2000)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
ModelHash = Annotated[str, Field(pattern=r"^([0-9a-f]{64})?$")]
Time = Annotated[float, Field(ge=0, le=253402300799)]
Metres = Annotated[float, Field(ge=0, le=20000)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Address = Annotated[int, Field(ge=0, le=127)]
# Not every language has unsigned integers of 64 bits.
Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
Ordinal = Annotated[int, Field(ge=1, le=2**63 - 1)]
# Becomes part of file names, so its characters and its length are bounded.
RecordId = Annotated[str, Field(pattern=r"^[!-~]{1,64}$")]

Channel = Literal["port", "starboard"]
Verdict = Literal["mine_like", "not_mine_like", "unsure"]
CommandKind = Literal["refine", "resend", "revisit", "wider"]
TaskingKind = Literal["advice", "command"]
DeliveryState = Literal["waiting", "delivered", "refused"]
DownlinkKind = Literal["refine", "resend", "revisit", "decision", "wider"]
DownlinkStep = Literal["asked", "sent", "confirmed", "refused", "expired"]
ServiceState = Literal["starting", "ok", "degraded", "stopping"]


class Record(BaseModel):
    """Base of every record: frozen, strictly typed, unknown fields ignored (a newer minor version adds fields)."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)

    TYPE: ClassVar[str] = ""
    VERSION: ClassVar[int] = 1


class Pixels(Record):
    """A grey picture: rows along-track, columns across-track, row by row, little endian."""

    TYPE: ClassVar[str] = "raster"

    height_px: Annotated[int, Field(ge=1, le=4096)]
    width_px: Annotated[int, Field(ge=1, le=4096)]
    bits: Literal[8, 16]
    data: bytes

    @field_validator("data")
    @classmethod
    def _length_fits(cls, data: bytes, info: ValidationInfo) -> bytes:
        if not {"height_px", "width_px", "bits"} <= info.data.keys():
            return data  # one of them is wrong itself, and is what the error is about
        height_px, width_px, bits = info.data["height_px"], info.data["width_px"], info.data["bits"]
        expected = height_px * width_px * bits // 8
        if len(data) != expected:
            raise ValueError(f"{expected} bytes for {height_px} x {width_px} px of {bits} bits, not {len(data)}")
        return data

    @classmethod
    def from_array(cls, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> Pixels:
        """Make a raster of an array.

        Args:
            image: Shape (height_px, width_px), uint8 or uint16 of any byte order and memory layout.

        Raises:
            BadInputError: Another shape or type: a cast would change values without a word.
        """
        if image.ndim != 2 or image.dtype.kind != "u" or image.dtype.itemsize not in (1, 2):
            raise BadInputError(
                "raster", "image", f"{image.dtype} of shape {image.shape}", "rows and columns of uint8 or uint16"
            )
        bits: Literal[8, 16] = 8 if image.dtype == np.uint8 else 16
        data = image.astype("<u1" if bits == 8 else "<u2").tobytes()
        return cls(height_px=image.shape[0], width_px=image.shape[1], bits=bits, data=data)

    def to_array(self) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16]:
        """Return a new array, shape (height_px, width_px), uint8 or uint16."""
        shape = (self.height_px, self.width_px)
        if self.bits == 8:
            return np.frombuffer(self.data, dtype=np.uint8).reshape(shape).copy()
        return np.frombuffer(self.data, dtype="<u2").reshape(shape).astype(np.uint16)

    @property
    def sha256(self) -> str:
        """Hex digest of the pixel bytes, by which two platforms compare pictures."""
        return hashlib.sha256(self.data).hexdigest()


class Contact(Record):
    """What the detector knows of one object. `atd_confidence` is 0.0 to 2.0, as in the paper.

    `height_m` is shadow x altitude / (slant range + shadow), on a flat bottom.
    """

    TYPE: ClassVar[str] = "contact"

    contact_id: Annotated[str, Field(min_length=1, max_length=120)]
    vehicle_id: PlatformId
    sonar_id: Text | None = None
    line_name: Text | None = None
    ping_number: Count | None = None
    channel: Channel | None = None
    time_utc_s: Time | None = None
    lat_deg: Latitude | None = None
    lon_deg: Longitude | None = None
    position_sigma_m: Metres | None = None
    depth_m: Annotated[float, Field(ge=-100, le=12000)] | None = None
    altitude_m: Metres | None = None
    heading_deg: Annotated[float, Field(ge=0, lt=360)] | None = None
    speed_mps: Annotated[float, Field(ge=-50, le=50)] | None = None
    slant_range_m: Metres | None = None
    ground_range_m: Metres | None = None
    atd_class: Annotated[str, Field(max_length=60)] | None = None
    atd_confidence: Annotated[float, Field(ge=0, le=2)] | None = None
    length_m: Metres | None = None
    width_m: Metres | None = None
    shadow_m: Metres | None = None
    height_m: Metres | None = None
    pixel_along_m: Annotated[float, Field(gt=0, le=100)] | None = None
    pixel_across_m: Annotated[float, Field(gt=0, le=100)] | None = None


class Snippet(Record):
    """A contact and its picture (the paper's imgToCompress). The nadir is to the left where the sonar is known.

    Attributes:
        wide: More of the seabed around the contact: pixels of twice the size of those of `picture`, along and across.
            It stays on the vehicle until the vessel asks for it; None where there is none.
    """

    TYPE: ClassVar[str] = "snippet"

    contact: Contact
    picture: Pixels
    source: Text = ""
    wide: Pixels | None = None


class EncodedImage(Record):
    """A picture as a codec stream, ready for the acoustic link (imgToDecompress, UUV side)."""

    TYPE: ClassVar[str] = "encoded_image"

    vehicle_id: PlatformId
    image_id: ImageId
    contact: Contact
    codec: Annotated[str, Field(min_length=1, max_length=40)]
    model: ModelHash
    height_px: Annotated[int, Field(ge=1, le=4096)]
    width_px: Annotated[int, Field(ge=1, le=4096)]
    stream: Annotated[bytes, Field(min_length=2, max_length=65542)]
    original_sha256: Sha256


class LinkQuality(Record):
    """What the receiving modem measured of one packet (from CACST)."""

    TYPE: ClassVar[str] = "link_quality"

    snr_in_db: float | None = None
    snr_out_db: float | None = None
    spl_db: float | None = None
    mse_db: float | None = None
    doppler: float | None = None
    frames: Count | None = None
    bad_frames: Count | None = None


class AcousticFrame(Record):
    """One frame that went into the water (`tx`) or came out of it (`rx`)."""

    TYPE: ClassVar[str] = "acoustic_frame"

    direction: Literal["tx", "rx"]
    platform_id: PlatformId
    time_utc_s: Time
    source: Address
    destination: Address
    rate: Annotated[int, Field(ge=0, le=6)] | None
    packet: Count
    frame_number: Annotated[int, Field(ge=1, le=8)]
    frame_count: Annotated[int, Field(ge=0, le=8)] | None
    data: Annotated[bytes, Field(max_length=2048)]
    quality: LinkQuality | None = None


class ReconstructedImage(Record):
    """A picture as the surface vessel rebuilt it (imgToDecompress, operator side, decoded).

    Attributes:
        version: 1 for the first picture given out under this identifier; more when later frames added to it.
        missing_mask: One bit a pixel, row by row, most significant first, 1 where nothing was received or what was
            received cannot be right (those pixels are black); empty when nothing is missing.
    """

    TYPE: ClassVar[str] = "reconstructed_image"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    version: Ordinal
    contact: Contact | None
    codec: Annotated[str, Field(max_length=40)]
    model: ModelHash
    picture: Pixels
    picture_sha256: Sha256
    complete: bool
    missing_fraction: Fraction
    missing_mask: bytes
    missing_halves: tuple[Literal["top", "bottom"], ...]
    bytes_received: Count
    bytes_total: Count
    frames_received: Count
    first_frame_utc_s: Time
    last_frame_utc_s: Time
    notes: tuple[Text, ...] = ()

    @field_validator("picture_sha256")
    @classmethod
    def _is_of_the_picture(cls, sha256: str, info: ValidationInfo) -> str:
        picture = info.data.get("picture")
        if isinstance(picture, Pixels) and picture.sha256 != sha256:
            raise ValueError(f"{picture.sha256}, the sha256 of the picture's bytes")
        return sha256

    @field_validator("missing_mask")
    @classmethod
    def _fits_the_picture(cls, mask: bytes, info: ValidationInfo) -> bytes:
        picture = info.data.get("picture")
        if isinstance(picture, Pixels):
            size = (picture.height_px * picture.width_px + 7) // 8
            if len(mask) not in (0, size):
                raise ValueError(f"0 or {size} bytes, not {len(mask)}")
        return mask

    def missing(self) -> npt.NDArray[np.bool_]:
        """Return the mask of missing pixels, shape (height_px, width_px)."""
        shape = (self.picture.height_px, self.picture.width_px)
        if not self.missing_mask:
            return np.zeros(shape, dtype=np.bool_)
        bits = np.unpackbits(np.frombuffer(self.missing_mask, dtype=np.uint8))
        return bits[: shape[0] * shape[1]].reshape(shape).astype(np.bool_)


class OutgoingMessage(Record):
    """Anything else a vehicle's program wants sent by sound: vehicle status, a position.

    Attributes:
        message_id: The same one given again is the same message and is sent once.
        source: The program; programs of one priority share the water evenly.
        priority: 1 first to 7 last. Up to 5 goes before pictures, below that into what frames leave free.
        lifetime_s: For how long after `created_utc_s` it is worth sending.
        data: Goes through the water as it is.
    """

    TYPE: ClassVar[str] = "outgoing_message"

    message_id: RecordId
    source: Annotated[str, Field(min_length=1, max_length=40)]
    priority: Annotated[int, Field(ge=1, le=7)]
    lifetime_s: Annotated[float, Field(gt=0, le=604800)]
    created_utc_s: Time
    data: Annotated[bytes, Field(min_length=1, max_length=1024)]


class QueuedImage(Record):
    """One picture in the acoustic queue.

    Attributes:
        bytes_left: Of frames still to be sent for it, redundancy included, by the plan so far.
        preview_utc_s: When its record and coarse picture are expected to have gone; None where they have.
        expected_utc_s: When all of it that is planned is expected to have gone.
    """

    TYPE: ClassVar[str] = "queued_image"

    image_id: ImageId
    contact_id: Annotated[str, Field(min_length=1, max_length=120)]
    bytes_left: Count
    preview_utc_s: Time | None
    expected_utc_s: Time


class QueueState(Record):
    """What waits in a vehicle's acoustic queue, and when it is expected to have gone.

    Attributes:
        rate: Micro-Modem rate in use.
        frame_loss: Share of frames lost, as the receiver's reports tell; None while it is not known.
        packet_interval_s: Time from one packet to the next, with what medium access costs.
        images: Those that have not gone, the first to be finished first; at most 500.
    """

    TYPE: ClassVar[str] = "queue_state"

    platform_id: PlatformId
    time_utc_s: Time
    rate: Annotated[int, Field(ge=0, le=6)]
    frame_loss: Fraction | None
    packet_interval_s: Annotated[float, Field(ge=0, le=86400)]
    messages_waiting: Count
    message_bytes: Count
    images_waiting: Count
    images: Annotated[tuple[QueuedImage, ...], Field(max_length=500)]


class ReceivedMessage(Record):
    """A message of a vehicle, as it came out of the water.

    Attributes:
        data: As its source on the vehicle gave it.
    """

    TYPE: ClassVar[str] = "received_message"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    received_utc_s: Time
    data: Annotated[bytes, Field(min_length=1, max_length=4096)]


class DownlinkState(Record):
    """How far a command or decision has come on its way to a vehicle.

    Attributes:
        record_id: Its `command_id` or `decision_id`.
        state: asked: on the vessel's disk. sent: in the water, perhaps heard. confirmed: on the vehicle's disk.
            refused: the vehicle cannot do it. expired: nobody has confirmed it in time.
        times_sent: How often it has gone into the water.
        reason: With `refused`: the vehicle's.
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


class Decision(Record):
    """What an operator decided about one picture."""

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


class Command(Record):
    """What the vessel asks of a vehicle, carried by sound."""

    TYPE: ClassVar[str] = "command"

    command_id: RecordId
    kind: CommandKind
    vehicle_id: PlatformId
    image_id: Annotated[ImageId | None, Field(validate_default=True)] = None
    lat_deg: Annotated[Latitude | None, Field(validate_default=True)] = None
    lon_deg: Annotated[Longitude | None, Field(validate_default=True)] = None
    issued_by: Annotated[str, Field(min_length=1, max_length=120)]
    issued_utc_s: Time

    @field_validator("image_id")
    @classmethod
    def _names_an_image(cls, image_id: str | None, info: ValidationInfo) -> str | None:
        kind = info.data.get("kind")
        if image_id is None and kind in ("refine", "resend", "wider"):
            raise ValueError("the image to show more around" if kind == "wider" else f"the image to {kind}")
        return image_id

    @field_validator("lat_deg", "lon_deg")
    @classmethod
    def _says_where(cls, degrees: float | None, info: ValidationInfo) -> float | None:
        if degrees is None and info.data.get("kind") == "revisit":
            raise ValueError("where to revisit")
        return degrees


class Advice(Record):
    """What an expert ashore thinks of one picture, for the operator on the vessel."""

    TYPE: ClassVar[str] = "advice"

    advice_id: RecordId
    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    image_version: Ordinal
    verdict: Verdict | None = None
    confidence: Fraction | None = None
    mlo_class: Annotated[str, Field(max_length=60)] | None = None
    remark: Text = ""
    author: Annotated[str, Field(min_length=1, max_length=120)]
    advised_utc_s: Time


class TaskingState(Record):
    """How far advice or a command from the shore has come; `delivered`: it is on the vessel's disk."""

    TYPE: ClassVar[str] = "tasking_state"

    vessel_id: PlatformId
    kind: TaskingKind
    record_id: RecordId
    state: DeliveryState
    reason: Text = ""
    changed_utc_s: Time


class Relayed(Record):
    """Envelope of what the vessel sends ashore: another record's key and payload, unchanged."""

    TYPE: ClassVar[str] = "relayed"

    vessel_id: PlatformId
    key: Annotated[str, Field(min_length=1, max_length=300)]
    payload: bytes
    relayed_utc_s: Time


class Health(Record):
    """A service's state, published at intervals."""

    TYPE: ClassVar[str] = "health"

    platform_id: PlatformId
    service: Annotated[str, Field(min_length=1, max_length=40)]
    time_utc_s: Time
    started_utc_s: Time
    state: ServiceState
    detail: Text = ""
    counters: dict[str, Count]
    gauges: dict[str, float]
