"""Records of an image: encoded on the vehicle, received, reconstructed."""

from __future__ import annotations

from typing import Annotated, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationInfo, field_validator

from sonarpost.limits import limit
from sonarpost.messages.contact import Contact, Pixels
from sonarpost.messages.record import (
    Count,
    Crc32,
    Fraction,
    ImageId,
    ModelHash,
    ModelId,
    Ordinal,
    PlatformId,
    Record,
    Sha256,
    Text,
    Time,
)

MAX_STREAM_BYTES: Final = 65542
"""Longest stream of an image, header included."""
MAX_SIDE_PX: Final = limit(
    512, "px", "claims", "coded images", "vessel, vehicle", "claimed side of an image", "the record is refused"
)
"""Largest side of a coded image, as in `sonarpost.codec.interface`."""
SidePx = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]


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
    height_px: SidePx
    width_px: SidePx
    stream: Annotated[bytes, Field(min_length=2, max_length=MAX_STREAM_BYTES)]
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
        authenticated: Whether all acoustic frames that contributed were authenticated with a key. None: not known.
    """

    TYPE: ClassVar[str] = "received_image"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    version: Ordinal
    contact: Contact | None
    height_px: SidePx | None
    width_px: SidePx | None
    stream: Annotated[bytes, Field(max_length=MAX_STREAM_BYTES)]
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
        if missing and isinstance(stream, bytes):
            bounds = [bound for first_and_stop in missing for bound in first_and_stop]
            if bounds != sorted(set(bounds)) or (bounds and bounds[-1] > len(stream)):
                raise ValueError(f"ascending, separate ranges within the {len(stream)} bytes of the stream")
        return missing


class CodedImage(ReceivedImage):
    """The coded content of an image that the vessel has decoded, with what identifies decoder and result.

    A later record of the same image has a higher `version` and replaces the earlier ones.

    Attributes:
        codec: Name of the codec; empty if only the contact frame arrived, or if the name is not known.
        model: First 32 hexadecimal digits of the identity of the codebook that the decoder needs; empty for a codec
            without codebooks, whose models are part of the software.
        pixels_crc32: CRC-32 of the pixels that the vessel decoded (`data` of the pixels of its
            `reconstructed_image`). None if not known.
    """

    TYPE: ClassVar[str] = "coded_image"

    codec: Annotated[str, Field(max_length=40)]
    model: ModelId
    pixels_crc32: Crc32 | None = None


class ImagePart(Record):
    """A coded image on its way from a vessel to a shore site: the whole, or the difference to an earlier version.

    Names are short and fields with their default value are absent, because the record travels over radio and satellite
    links. The key names the vessel. The Zenoh specification defines how a site applies a difference.

    Attributes:
        u: Vehicle (`vehicle_id` of `coded_image`).
        i: Image (`image_id`).
        n: Version.
        b: Version to which this record is the difference; 0 for a whole image.
        t: Arrival of the first frame (`first_frame_utc_s`).
        d: Arrival of the last frame (`last_frame_utc_s`) after `t`, in units of 2^-22 s: the resolution of the present
            time as float 64.
        l: Arrival of the last frame, if `d` cannot represent it exactly. None: `d` does.
        c: The contact: the 25 bytes of the contact record of the acoustic link, which include height and width; if
            they cannot represent it, a msgpack map of the fields of `contact` that are not nil, without `contact_id`
            and `vehicle_id` if these are `u`/`i` and `u` and the map does not have 25 bytes then. Empty: no contact,
            or that of version `b`.
        h: Rows (`height_px`), if `c` is not a contact record of 25 bytes.
        w: Columns (`width_px`), as `h`.
        z: Length of the stream. None: the end of its last piece.
        p: The piece of the stream at its first byte; empty if there is none.
        s: The other pieces of the stream: first byte and content, ascending, separate, within the stream.
        m: Ranges of the stream that have not arrived (`missing`).
        k: In a difference, the CRC-32 of the stream, zeros in the missing ranges, followed by the bytes of `c` of the
            whole image. None in a whole image.
        x: CRC-32 of the decoded pixels (`pixels_crc32`).
        f: Frames (`frames_received`).
        e: Planned length (`bytes_total`). None: `z`.
        y: Received bytes (`bytes_received`). None: `z` without the ranges `m`.
        q: Contradicting frames (`conflicts`).
        g: Sum of 1 (`complete`), 2 (`authenticated` is true), 4 (`authenticated` is false), 8 (top half missing) and
            16 (bottom half missing).
        a: First 16 bytes of the identity of the codebook (`model`); empty if the codec needs none.
    """

    TYPE: ClassVar[str] = "part"
    SPARSE: ClassVar[bool] = True

    u: PlatformId
    i: ImageId
    n: Ordinal
    b: Count = 0
    t: Time
    d: Count = 0
    l: Time | None = None  # noqa: E741  short on the wire
    c: Annotated[bytes, Field(max_length=20_000)] = b""
    h: SidePx | None = None
    w: SidePx | None = None
    z: Annotated[int, Field(ge=0, le=MAX_STREAM_BYTES)] | None = None
    p: Annotated[bytes, Field(max_length=MAX_STREAM_BYTES)] = b""
    s: tuple[tuple[Count, bytes], ...] = ()
    m: Annotated[tuple[tuple[Count, Count], ...], Field(max_length=MAX_STREAM_BYTES // 2)] = ()
    k: Crc32 | None = None
    x: Crc32 | None = None
    f: Count = 0
    e: Count | None = None
    y: Count | None = None
    q: Count = 0
    g: Annotated[int, Field(ge=0, le=31)] = 2
    a: Annotated[bytes, Field(max_length=16)] = b""

    @field_validator("b")
    @classmethod
    def _check_base(cls, base: int, info: ValidationInfo) -> int:
        if "n" in info.data and base >= info.data["n"]:
            raise ValueError(f"less than the version {info.data['n']}")
        return base

    @field_validator("p")
    @classmethod
    def _check_first(cls, piece: bytes, info: ValidationInfo) -> bytes:
        length = info.data.get("z")
        if length is not None and len(piece) > length:
            raise ValueError(f"at most the {length} bytes of the stream")
        return piece

    @field_validator("s")
    @classmethod
    def _check_pieces(
        cls, pieces: tuple[tuple[int, bytes], ...], info: ValidationInfo
    ) -> tuple[tuple[int, bytes], ...]:
        end, length = len(info.data.get("p", b"")), info.data.get("z")
        length = MAX_STREAM_BYTES if length is None else length
        for first, content in pieces:
            if first < end or not content or first + len(content) > length:
                raise ValueError(f"ascending, separate, non-empty pieces within the {length} bytes of the stream")
            end = first + len(content)
        return pieces

    @field_validator("m")
    @classmethod
    def _check_missing(cls, missing: tuple[tuple[int, int], ...], info: ValidationInfo) -> tuple[tuple[int, int], ...]:
        pieces = ((0, info.data.get("p", b"")), *info.data.get("s", ()))
        length = info.data.get("z")
        length = pieces[-1][0] + len(pieces[-1][1]) if length is None else length
        bounds = [bound for first_and_stop in missing for bound in first_and_stop]
        if bounds != sorted(set(bounds)) or (bounds and bounds[-1] > length):
            raise ValueError(f"ascending, separate ranges within the {length} bytes of the stream")
        return missing

    @field_validator("a")
    @classmethod
    def _check_model(cls, model: bytes) -> bytes:
        if len(model) not in (0, 16):
            raise ValueError("0 or 16 bytes")
        return model


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
        pixels: The pixels; missing ones are black.
        pixels_sha256: Digest of the pixels (`data`): equal for the same image on every platform.
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
        authenticated: Whether all acoustic frames that contributed were authenticated with a key. None: not known.
        despeckle_strength: Strength with which the vehicle removed speckle before coding, 0 for none. None: not known,
            as with codecs without despeckling.
    """

    TYPE: ClassVar[str] = "reconstructed_image"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    image_id: ImageId
    version: Ordinal
    contact: Contact | None
    codec: Annotated[str, Field(max_length=40)]
    model: ModelHash
    pixels: Pixels
    pixels_sha256: Sha256
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

    @field_validator("pixels_sha256")
    @classmethod
    def _check_digest(cls, sha256: str, info: ValidationInfo) -> str:
        pixels = info.data.get("pixels")
        if isinstance(pixels, Pixels) and pixels.sha256 != sha256:
            raise ValueError(f"{pixels.sha256}, the sha256 of the pixels")
        return sha256

    @field_validator("missing_mask")
    @classmethod
    def _check_mask(cls, mask: bytes, info: ValidationInfo) -> bytes:
        pixels = info.data.get("pixels")
        if isinstance(pixels, Pixels):
            size = (pixels.height_px * pixels.width_px + 7) // 8
            if len(mask) not in (0, size):
                raise ValueError(f"0 or {size} bytes, not {len(mask)}")
        return mask

    def missing(self) -> npt.NDArray[np.bool_]:
        """Return the mask of missing pixels, shape (height_px, width_px)."""
        shape = (self.pixels.height_px, self.pixels.width_px)
        if not self.missing_mask:
            return np.zeros(shape, dtype=np.bool_)
        bits = np.unpackbits(np.frombuffer(self.missing_mask, dtype=np.uint8))
        return bits[: shape[0] * shape[1]].reshape(shape).astype(np.bool_)
