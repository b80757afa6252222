"""The records that services exchange over Zenoh.

A record is validated when it is constructed. On the wire it is a plain msgpack map with two more fields, `type` and `v`
(see `sonarpost.wire`). `docs/specifications/zenoh.md` specifies the same for other languages. A value that is not known
is None. Times are seconds since 1970-01-01 UTC.
"""

from __future__ import annotations

import hashlib
from typing import Annotated, ClassVar, Final, Literal

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
CommandKind = Literal["refine", "resend", "revisit", "wider", "original", "region", "prioritise"]
QueuePlace = Literal["first", "last"]
BoxStart = Annotated[int, Field(ge=0, le=31)]
BoxEnd = Annotated[int, Field(ge=1, le=32)]
TaskingKind = Literal["advice", "command"]
AtdClass = Literal["mine-like", "clutter", "structure"]
DeliveryState = Literal["waiting", "delivered", "refused"]
DownlinkKind = Literal["refine", "resend", "revisit", "decision", "wider", "original", "region", "prioritise"]
DownlinkStep = Literal["asked", "sent", "confirmed", "refused", "expired"]
ServiceState = Literal["starting", "ok", "degraded", "stopping"]

MAX_OVERRULED: Final = 16
"""Decisions that one decision can overrule."""

MAX_TRANSMISSION_S: Final = 300.0
"""Longer than any transmission of a modem; a longer one in a record means damage."""

MIN_REGION_BYTES: Final = 24
"""Shortest stream of a region."""

_IMAGE_OF_COMMAND: Final = {
    "refine": "the image to refine",
    "resend": "the image to resend",
    "wider": "the image to show more around",
    "original": "the image to send without despeckling",
    "region": "the image with the region",
    "prioritise": "the image to move in the queue",
}
"""The image that each kind of command names, for error messages."""


PROBABILITY_TOLERANCE: Final = 1e-6
"""By how much the sum of the probabilities of a contact may exceed 1, because of rounding."""


class Record(BaseModel):
    """Base of every record: frozen, strictly typed, unknown fields ignored (a newer minor version adds fields)."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)

    TYPE: ClassVar[str] = ""
    VERSION: ClassVar[int] = 1


class Pixels(Record):
    """A grey image, row by row from the top, each row from its first column, without padding, 16 bits little endian.

    The pixel in row r and column c (from 0) begins at byte (r * width_px + c) * bits / 8.

    Attributes:
        height_px: Rows, along-track.
        width_px: Columns, across-track.
        bits: Bits of a pixel, unsigned; 0 is black.
        data: The pixels, height_px * width_px * bits / 8 bytes.
    """

    TYPE: ClassVar[str] = "raster"

    height_px: Annotated[int, Field(ge=1, le=4096)]
    width_px: Annotated[int, Field(ge=1, le=4096)]
    bits: Literal[8, 16]
    data: bytes

    @field_validator("data")
    @classmethod
    def _check_length(cls, data: bytes, info: ValidationInfo) -> bytes:
        if not {"height_px", "width_px", "bits"} <= info.data.keys():
            return data  # one of these fields is invalid, and the error is about it
        height_px, width_px, bits = info.data["height_px"], info.data["width_px"], info.data["bits"]
        expected = height_px * width_px * bits // 8
        if len(data) != expected:
            raise ValueError(f"{expected} bytes for {width_px} × {height_px} px of {bits} bits, not {len(data)}")
        return data

    @classmethod
    def from_array(cls, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> Pixels:
        """Return the pixels of an array.

        Args:
            image: Shape (height_px, width_px), uint8 or uint16 of any byte order and memory layout.

        Raises:
            BadInputError: Another shape or type; a cast would change values silently.
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
        """Hexadecimal SHA-256 digest of the pixel bytes, equal for the same image on every platform."""
        return hashlib.sha256(self.data).hexdigest()


class Contact(Record):
    """An object on the seabed that the detector reports.

    Attributes:
        contact_id: Unique on the vehicle. On the vessel and at the shore site `{vehicle}/{image_id}`, because the
            acoustic link does not carry the detector's identifier.
        vehicle_id: Vehicle that recorded it.
        sonar_id: Sonar, as the survey file names it. None if not known, as in all fields below.
        line_name: Survey line.
        ping_number: Ping at the middle of the object.
        channel: Side of the sonar.
        time_utc_s: Time of that ping.
        lat_deg: Position of the object, north positive.
        lon_deg: Position of the object, east positive.
        position_sigma_m: One standard deviation of the position along the worse axis of its error ellipse.
        depth_m: Depth of the vehicle below the surface.
        altitude_m: Altitude of the vehicle above the seabed.
        heading_deg: Heading of the vehicle, clockwise from true north.
        speed_mps: Speed of the vehicle, forward positive.
        slant_range_m: Distance from the sonar to the object.
        ground_range_m: The same along a flat seabed.
        atd_class: Class that the detector assigned: `mine-like`, `clutter` (any other object) or `structure` (a wreck,
            a wall, an outcrop); `picked` if only a person has marked the place. Other detectors may use other names;
            the acoustic link does not carry those.
        atd_confidence: Confidence of the detector as in the paper, 2 is the highest.
        length_m: Length along-track.
        width_m: Width across-track.
        shadow_m: Length of the shadow, up to the end of the recording.
        height_m: Height above a flat seabed: shadow * altitude / (slant range + shadow). None if the recording ends
            before the shadow does.
        pixel_along_m: Size of a pixel of the image, along-track.
        pixel_across_m: Size of a pixel of the image, across-track.
        p_mine_like: Probability that the contact is a mine-like object, together with `p_other_object`; their sum is
            at most 1. None: not classified, and in records of earlier versions. The acoustic link rounds both to
            multiples of 0.05.
        p_other_object: Probability that it is another object on the seabed. The rest is the probability that there is
            seabed alone.
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
    p_mine_like: Fraction | None = None
    p_other_object: Annotated[Fraction | None, Field(validate_default=True)] = None

    @field_validator("p_other_object")
    @classmethod
    def _check_probabilities(cls, p_other_object: float | None, info: ValidationInfo) -> float | None:
        if "p_mine_like" not in info.data:
            return p_other_object  # `p_mine_like` is invalid, and the error is about it
        p_mine_like = info.data["p_mine_like"]
        if (p_mine_like is None) != (p_other_object is None):
            raise ValueError("a value together with p_mine_like, or neither")
        if p_mine_like is not None and p_mine_like + p_other_object > 1 + PROBABILITY_TOLERANCE:
            raise ValueError(f"at most {1 - p_mine_like:.6g}, so that the sum with p_mine_like is at most 1")
        return p_other_object


class Snippet(Record):
    """A contact and its pixels, cut from a survey (the paper's imgToCompress).

    Attributes:
        contact: The contact.
        picture: The pixels, nadir to the left if `channel` is known. The compressor accepts sides of 16 to 512 px.
        source: Name of the file in which the contact was detected.
        wide: More seabed around the same centre, in pixels of twice the size along and across, sides of 16 to 512 px.
            It stays on the vehicle until a command of kind `wider` requests it. None if there is none.
    """

    TYPE: ClassVar[str] = "snippet"

    contact: Contact
    picture: Pixels
    source: Text = ""
    wide: Pixels | None = None


class EncodedImage(Record):
    """An image as a codec stream, ready for the acoustic link (the paper's imgToDecompress on the vehicle).

    Attributes:
        vehicle_id: Vehicle that encoded it.
        image_id: Identifier of the image on the acoustic link; 1 to 65535 in base 36, repeated after 65535 images.
        contact: The contact that the image shows.
        codec: Name of the codec.
        model: Identity of the codebook or model that the decoder needs; empty if it needs none.
        height_px: Rows of the original.
        width_px: Columns of the original.
        stream: The codec's stream, header included.
        original_sha256: Digest of the original's pixels (`data` of the snippet).
    """

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
    """What the receiving modem measured of one packet (its CACST message). None: not reported.

    Attributes:
        snr_in_db: Signal-to-noise ratio at the equaliser's input.
        snr_out_db: Signal-to-noise ratio at the equaliser's output.
        spl_db: Sound pressure level re 1 µPa.
        mse_db: Mean squared error of the equaliser.
        doppler: Doppler, as the firmware reports it.
        frames: Frames of the packet.
        bad_frames: Frames that failed the modem's check.
    """

    TYPE: ClassVar[str] = "link_quality"

    snr_in_db: float | None = None
    snr_out_db: float | None = None
    spl_db: float | None = None
    mse_db: float | None = None
    doppler: float | None = None
    frames: Count | None = None
    bad_frames: Count | None = None


class AcousticFrame(Record):
    """One frame that a modem transmitted (`tx`) or received (`rx`).

    Attributes:
        direction: Transmitted or received.
        platform_id: Platform of the modem.
        time_utc_s: End of the packet by that platform's clock.
        source: Address of the transmitting modem.
        destination: Address that it was sent to; 127 is all modems.
        rate: Micro-Modem rate number. None if the modem did not report it.
        packet: Number of the packet on that platform.
        frame_number: Number of the frame within its packet.
        frame_count: Frames of the packet. None if the modem did not report it.
        data: Content of the frame, padding included.
        quality: Measurements of the packet. None if there are none.
    """

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


class ReceivedImage(Record):
    """The coded content of an image as far as the vessel has received it.

    A later record of the same image has a higher `version` and replaces the earlier ones.

    Attributes:
        vessel_id: Vessel that received it.
        vehicle_id: Vehicle that sent it, identified by the address of its modem.
        image_id: Identifier of the image on the acoustic link.
        version: 1 for the first record of this image; counts up as more of it arrives.
        contact: The contact as far as the acoustic link carries it. None if the contact frame has not arrived.
        height_px: Rows of the image, from the contact frame. None if not known.
        width_px: Columns of the image, from the contact frame. None if not known.
        stream: The codec's stream, header included, with zeros in the ranges `missing`. Empty if no header has arrived.
        missing: Ranges of `stream` that have not arrived: first byte and the byte after the last one, ascending.
        missing_halves: Halves (in the sense of the paper) of which no byte arrived.
        complete: Everything arrived that the vehicle has planned to send so far.
        bytes_received: Bytes of the stream that arrived.
        bytes_total: Length of the stream that the vehicle has planned to send so far; 0 if not known.
        frames_received: Acoustic frames used; 0 if the wire format does not count them.
        conflicts: Frames that contradict others of this image.
        first_frame_utc_s: Arrival of the first frame, by the vessel's clock.
        last_frame_utc_s: Arrival of the last frame that contributed.
        authenticated: Whether all acoustic frames that contributed were authenticated with a key. None: not known, in
            records of earlier versions.
    """

    TYPE: ClassVar[str] = "received_image"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    version: Ordinal
    contact: Contact | None
    height_px: Annotated[int, Field(ge=1, le=4096)] | None
    width_px: Annotated[int, Field(ge=1, le=4096)] | None
    stream: Annotated[bytes, Field(max_length=65542)]
    missing: tuple[tuple[Count, Count], ...]
    missing_halves: tuple[Literal["top", "bottom"], ...]
    complete: bool
    bytes_received: Count
    bytes_total: Count
    frames_received: Count
    conflicts: Count
    first_frame_utc_s: Time
    last_frame_utc_s: Time
    authenticated: bool | None = None

    @field_validator("missing")
    @classmethod
    def _fit_the_stream(cls, missing: tuple[tuple[int, int], ...], info: ValidationInfo) -> tuple[tuple[int, int], ...]:
        stream = info.data.get("stream")
        if isinstance(stream, bytes):
            bounds = [bound for first_and_stop in missing for bound in first_and_stop]
            if bounds != sorted(set(bounds)) or (bounds and bounds[-1] > len(stream)):
                raise ValueError(f"ascending, separate ranges within the {len(stream)} bytes of the stream")
        return missing


class ReconstructedImage(Record):
    """An image as the vessel decoded it (the paper's imgToDecompress on the operator's side).

    Frames that arrive later lead to the same image again with a higher `version`.

    Attributes:
        vessel_id: Vessel that decoded it.
        vehicle_id: Vehicle that sent it, identified by the address of its modem.
        image_id: Identifier of the image on the acoustic link.
        version: 1 for the first version of this image; counts up as more of it arrives.
        contact: The contact as far as the acoustic link carries it. None if the contact frame has not arrived.
        codec: Name of the codec; empty if only the contact frame arrived.
        model: Identity of the codebook or model; empty if none was needed.
        picture: The pixels; missing ones are black.
        picture_sha256: Digest of the pixels (`data`): equal for the same image on every platform.
        complete: Everything arrived that the vehicle has planned to send so far, and no pixel is missing. A later
            version can have more bytes, for example after a request for more detail.
        missing_fraction: Fraction of the pixels that is missing.
        missing_mask: One bit a pixel, row by row without padding, most significant bit first: pixel n is bit 7 - n mod
            8 of byte n // 8. 1 where nothing was received or what was received cannot be right; empty if nothing is
            missing.
        missing_halves: Halves (in the sense of the paper) that did not arrive.
        bytes_received: Bytes of the stream that arrived.
        bytes_total: Length of the stream that the vehicle has planned to send so far; 0 if not known.
        frames_received: Acoustic frames used; 0 if the wire format does not count them.
        first_frame_utc_s: Arrival of the first frame, by the vessel's clock.
        last_frame_utc_s: Arrival of the last frame.
        notes: Remarks for the operator about this image.
        authenticated: Whether all acoustic frames that contributed were authenticated with a key. None: not known, in
            records of earlier versions.
        despeckle_strength: Strength with which the vehicle removed speckle before coding, 0 for none. None: not known,
            with codecs without despeckling and in records of earlier versions.
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
    authenticated: bool | None = None
    despeckle_strength: Fraction | None = None

    @field_validator("picture_sha256")
    @classmethod
    def _check_digest(cls, sha256: str, info: ValidationInfo) -> str:
        picture = info.data.get("picture")
        if isinstance(picture, Pixels) and picture.sha256 != sha256:
            raise ValueError(f"{picture.sha256}, the sha256 of the picture's bytes")
        return sha256

    @field_validator("missing_mask")
    @classmethod
    def _check_mask(cls, mask: bytes, info: ValidationInfo) -> bytes:
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
        rate: Micro-Modem rate in use.
        frame_loss: Fraction of frames lost, from the receiver's feedback. None if not known.
        packet_interval_s: Time from one packet to the next, medium access included.
        messages_waiting: Messages not yet sent.
        message_bytes: Bytes of these messages.
        images_waiting: Images not yet sent.
        images: These images, the first to be finished first; at most 500.
        images_accepted: New images ever accepted from the compressor; None from programs that do not count them.
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


class ReceivedMessage(Record):
    """A message of a vehicle's program as received on the vessel.

    Attributes:
        vessel_id: Vessel that received it.
        vehicle_id: Vehicle that sent it, identified by the address of its modem.
        received_utc_s: When it was received.
        data: Content, as its source on the vehicle gave it.
        authenticated: Whether its acoustic frames were authenticated with a key. None: not known, in records of earlier
            versions.
    """

    TYPE: ClassVar[str] = "received_message"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    received_utc_s: Time
    data: Annotated[bytes, Field(min_length=1, max_length=4096)]
    authenticated: bool | None = None


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
            `unsure` if there was none. None if the record is a decision, and in records of earlier versions.
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
        kind: refine: more detail. resend: the same again. wider: more seabed around the contact, as an image of its
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


class Advice(Record):
    """An expert's comment from the shore site on one image, for the operator on the vessel.

    Attributes:
        advice_id: Unique; repeated advice is recognised by it.
        vessel_id: Vessel of the operator; must be the vessel of the key.
        vehicle_id: Vehicle of the image.
        image_id: Identifier of the image.
        image_version: Version that the expert saw.
        verdict: The verdict. None if none is given.
        confidence: The expert's confidence. None if not given.
        mlo_class: Class of mine-like object. None if not classified.
        remark: Free text.
        author: Name of the expert.
        advised_utc_s: Time of the advice.
    """

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
    """Progress of advice or a command from the shore site to a vessel. c2 publishes it at every change.

    Attributes:
        vessel_id: Vessel that it is for.
        kind: Which record.
        record_id: Its `advice_id` or `command_id`.
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


class Relayed(Record):
    """Envelope of a record that a vessel sends to a shore site.

    Attributes:
        vessel_id: Must be the vessel of the inner key and record.
        key: Key of the inner record: this vessel's `image/reconstructed` or `contact/decision`.
        payload: The inner record, unchanged, with its `type` and `v`.
        relayed_utc_s: When the relay accepted it.
    """

    TYPE: ClassVar[str] = "relayed"

    vessel_id: PlatformId
    key: Annotated[str, Field(min_length=1, max_length=300)]
    payload: bytes
    relayed_utc_s: Time


class Health(Record):
    """A service's state, published every `health_interval_s` (5 s by default) and when the service stops.

    Attributes:
        platform_id: Platform of the service.
        service: Name of the service.
        time_utc_s: Time of this record.
        started_utc_s: Start of the process.
        state: degraded: the service runs, but something prevents part of its work.
        detail: What is wrong; empty if nothing is.
        counters: Events since the start, `records_handled` and `records_refused` among them.
        gauges: Present values. `inbox`, `outbox` and `refused` are numbers of records in the service's store,
            `disk_free_bytes` is the free space on its disk (absent if it cannot be read).
    """

    TYPE: ClassVar[str] = "health"

    platform_id: PlatformId
    service: Annotated[str, Field(min_length=1, max_length=40)]
    time_utc_s: Time
    started_utc_s: Time
    state: ServiceState
    detail: Text = ""
    counters: dict[str, Count]
    gauges: dict[str, float]
