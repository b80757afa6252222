"""Decoding of received images: from a `ReceivedImage` to a `ReconstructedImage`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sonarpost.codec.interface import Codec, DecodedImage, Mask, StreamHeader
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError
from sonarpost.link.receiver import has_header, received_mask
from sonarpost.messages import Pixels, ReceivedImage, ReconstructedImage

_UNKNOWN_SIDE_PX = 16


class Decoder:
    """Decodes images of every codec, with the codebook that their stream names.

    Args:
        codebooks: Names or files of tile codebooks.

    Raises:
        CodebookError: A codebook cannot be read, or two have the same tag.
    """

    def __init__(self, codebooks: Sequence[str]) -> None:
        self._tiles: dict[int, TileDatabase] = {}
        for name in codebooks:
            tiles = open_codebook(name).tiles
            tag = codebook_tag(tiles)
            if tag in self._tiles and self._tiles[tag].identity != tiles.identity:
                raise CodebookError(name, "identity", tiles.identity, f"a tag other than {tag:#06x}, which is taken")
            self._tiles[tag] = tiles

    def decode(self, received: ReceivedImage) -> ReconstructedImage:
        """Decode the received part of an image; without a stream header all pixels are missing.

        Raises:
            CodebookError: The codebook of the image is not configured.
            StreamError: The stream cannot be decoded.
        """
        if not has_header(received.stream):
            shape = received.height_px or _UNKNOWN_SIDE_PX, received.width_px or _UNKNOWN_SIDE_PX
            decoded = DecodedImage(np.zeros(shape, dtype=np.uint8), np.ones(shape, dtype=np.bool_))
            return _record(received, decoded, None, ["only the contact record arrived"])
        codec = self._codec(received)
        decoded = codec.decode(received.stream, received_mask(received.stream, received.missing))
        notes = list(decoded.notes)
        if received.conflicts:
            notes.append(f"{received.conflicts} frames disagreed with others of this image")
        return _record(received, decoded, codec, notes)

    def _codec(self, received: ReceivedImage) -> Codec:
        header = StreamHeader.unpack(received.stream)
        registry, tiles = default_registry(), None
        # The tag of a codec without tiles identifies another kind of model, or none.
        if registry.spec_for_id(header.codec_id).needs_tiles:
            tiles = self._tiles.get(header.model_tag)
            if tiles is None:
                known = ", ".join(f"{tag:#06x}" for tag in self._tiles)
                where = f"image {received.image_id}"
                raise CodebookError(where, "model_tag", f"{header.model_tag:#06x}", f"a configured codebook: {known}")
        return registry.create_for_stream(received.stream, CodecResources(tiles))


def _record(
    received: ReceivedImage, decoded: DecodedImage, codec: Codec | None, notes: Sequence[str]
) -> ReconstructedImage:
    picture = Pixels.from_array(decoded.image)
    return ReconstructedImage(
        vessel_id=received.vessel_id,
        vehicle_id=received.vehicle_id,
        image_id=received.image_id,
        version=received.version,
        contact=received.contact,
        codec=codec.name if codec else "",
        model=codec.model_hash if codec else "",
        picture=picture,
        picture_sha256=picture.sha256,
        complete=received.complete and not decoded.missing.any(),
        missing_fraction=float(decoded.missing.mean()),
        missing_mask=pack_mask(decoded.missing),
        missing_halves=received.missing_halves,
        bytes_received=received.bytes_received,
        bytes_total=received.bytes_total,
        frames_received=received.frames_received,
        first_frame_utc_s=received.first_frame_utc_s,
        last_frame_utc_s=received.last_frame_utc_s,
        notes=tuple(notes),
        authenticated=received.authenticated,
        despeckle_strength=decoded.despeckle_strength,
    )


def pack_mask(missing: Mask) -> bytes:
    """Return the mask of missing pixels as the record has it: empty if nothing is missing."""
    return np.packbits(missing).tobytes() if missing.any() else b""
