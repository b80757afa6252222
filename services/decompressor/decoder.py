"""From what the link gave out to the record of a reconstructed picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonarpost.codec.interface import Codec, DecodedImage, Mask, StreamHeader
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.receiver import ImageUpdate
from sonarpost.messages import Contact, Pixels, ReconstructedImage


class Decoder:
    """Decodes with whichever of its codebooks the sender used.

    Args:
        vessel_id: Name of the vessel in the records.
        codebooks: Names or files of tile codebooks.

    Raises:
        CodebookError: A codebook cannot be read, or two have the same tag.
    """

    def __init__(self, vessel_id: str, codebooks: Sequence[str]) -> None:
        self._vessel_id = vessel_id
        self._tiles: dict[int, TileDatabase] = {}
        for name in codebooks:
            tiles = open_codebook(name).tiles
            tag = codebook_tag(tiles)
            if tag in self._tiles and self._tiles[tag].identity != tiles.identity:
                raise CodebookError(name, "identity", tiles.identity, f"a tag other than {tag:#06x}, which is taken")
            self._tiles[tag] = tiles

    def image(self, event: ImageUpdate, vehicle_id: str) -> ReconstructedImage:
        """Decode an image as far as it has arrived; without a stream header all of it is missing.

        Raises:
            CodebookError: It was made with a codebook that is not at hand.
            StreamError: It cannot be decoded.
        """
        if not event.has_header:
            contact = event.contact
            shape = (contact and contact.height_px) or 16, (contact and contact.width_px) or 16
            decoded = DecodedImage(np.zeros(shape, dtype=np.uint8), np.ones(shape, dtype=np.bool_))
            return self._record(event, vehicle_id, decoded, None, ["only the contact record arrived"])
        codec = self._codec(StreamHeader.unpack(event.stream), event)
        decoded = codec.decode(event.stream, event.received_mask())
        notes = list(decoded.notes)
        if event.conflicts:
            notes.append(f"{event.conflicts} frames disagreed with others of this image")
        return self._record(event, vehicle_id, decoded, codec, notes)

    def _codec(self, header: StreamHeader, event: ImageUpdate) -> Codec:
        registry, tiles = default_registry(), None
        # The tag of a codec without tiles is that of another kind of model, or of none.
        if registry.spec_for_id(header.codec_id).needs_tiles:
            tag = header.model_tag
            tiles = self._tiles.get(tag)
            if tiles is None:
                own = ", ".join(f"{known:#06x}" for known in self._tiles)
                where = f"image {event.image_id}"
                raise CodebookError(where, "model_tag", f"{tag:#06x}", f"a codebook at hand: {own}")
        return registry.create_for_stream(event.stream, CodecResources(tiles))

    def _record(
        self,
        event: ImageUpdate,
        vehicle_id: str,
        decoded: DecodedImage,
        codec: Codec | None,
        notes: Sequence[str],
    ) -> ReconstructedImage:
        picture = Pixels.from_array(decoded.image)
        return ReconstructedImage(
            vessel_id=self._vessel_id,
            vehicle_id=vehicle_id,
            image_id=event.image_id,
            version=event.version,
            contact=contact_of(event, vehicle_id),
            codec=codec.name if codec else "",
            model=codec.model_hash if codec else "",
            picture=picture,
            picture_sha256=picture.sha256,
            complete=event.complete and not decoded.missing.any(),
            missing_fraction=float(decoded.missing.mean()),
            missing_mask=pack_mask(decoded.missing),
            missing_halves=event.missing_halves,
            bytes_received=event.received_bytes,
            bytes_total=event.total_bytes,
            frames_received=event.frames,
            first_frame_utc_s=event.first_frame_s,
            last_frame_utc_s=event.last_frame_s,
            notes=tuple(notes),
        )


def pack_mask(missing: Mask) -> bytes:
    """Return the mask as the record carries it: empty when nothing is missing."""
    return np.packbits(missing).tobytes() if missing.any() else b""


def contact_of(event: ImageUpdate, vehicle_id: str) -> Contact | None:
    """Return the contact as the vessel knows it, None when its record has not arrived.

    The vehicle's own contact identifier does not travel; on this side a contact is vehicle and image identifier.
    """
    summary: ContactSummary | None = event.contact
    if summary is None:
        return None
    return Contact(
        contact_id=f"{vehicle_id}/{event.image_id}",
        vehicle_id=vehicle_id,
        channel=summary.side.value if summary.side else None,
        time_utc_s=summary.time_utc_s,
        lat_deg=summary.lat_deg,
        lon_deg=summary.lon_deg,
        position_sigma_m=summary.position_sigma_m,
        depth_m=summary.depth_m,
        altitude_m=summary.altitude_m,
        heading_deg=summary.heading_deg,
        ground_range_m=summary.ground_range_m,
        atd_confidence=summary.confidence,
        pixel_along_m=summary.pixel_along_m,
        pixel_across_m=summary.pixel_across_m,
    )
