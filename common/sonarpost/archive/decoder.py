"""Decoding of received images: from the coded content to a `ReconstructedImage`.

The decompressor decodes on the vessel, and c2 at the shore site. Both get the same pixels from the same stream.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np

from sonarpost.codec.interface import Codec, DecodedImage, Mask, StreamHeader
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import Codebook, open_codebook
from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError, MissingCodebookError
from sonarpost.link.receiver import has_header, received_mask
from sonarpost.messages import CodedImage, Pixels, ReceivedImage, ReconstructedImage

_UNKNOWN_SIDE_PX = 16
MODEL_DIGITS = 32
"""Hexadecimal digits of the identity of a codebook in `coded_image`."""
OTHER_PIXELS = "decoded pixels differ from those of the vessel"
"""Note on an image whose pixels do not have the CRC-32 that the vessel has stated."""


class Decoder:
    """Decodes images of every codec, with the codebook that their stream names.

    Args:
        codebooks: Names or files of tile codebooks.

    Raises:
        CodebookError: A codebook cannot be read, or two have the same tag.
    """

    def __init__(self, codebooks: Sequence[str]) -> None:
        self._codebooks: dict[str, Codebook] = {}
        self._by_tag: dict[int, str] = {}
        for name in codebooks:
            codebook = open_codebook(name)
            tag, identity = codebook_tag(codebook.tiles), codebook.tiles.identity
            if self._by_tag.setdefault(tag, identity[:MODEL_DIGITS]) != identity[:MODEL_DIGITS]:
                raise CodebookError(name, "identity", identity, f"a tag other than {tag:#06x}, which is taken")
            self.add(codebook)

    def add(self, codebook: Codebook) -> None:
        """Add a codebook, which images name by its identity."""
        self._codebooks[codebook.tiles.identity[:MODEL_DIGITS]] = codebook

    def codebook(self, model: str) -> Codebook | None:
        """Return the codebook whose identity starts with these 32 hexadecimal digits."""
        return self._codebooks.get(model)

    def decode(self, received: ReceivedImage, further: Codebook | None = None) -> ReconstructedImage:
        """Decode the received part of an image; without a stream header all pixels are missing.

        The codebook is the one that a coded image names; for a received image, which names none, the configured one
        with the tag of the stream. `further` is one more codebook, for this image only.

        Raises:
            MissingCodebookError: The codebook of the image is not known.
            StreamError: The stream cannot be decoded.
        """
        if not has_header(received.stream):
            shape = received.height_px or _UNKNOWN_SIDE_PX, received.width_px or _UNKNOWN_SIDE_PX
            decoded = DecodedImage(np.zeros(shape, dtype=np.uint8), np.ones(shape, dtype=np.bool_))
            return _record(received, decoded, None, ["only the contact record arrived"])
        codec = self._codec(received, further)
        decoded = codec.decode(received.stream, received_mask(received.stream, received.missing))
        notes = list(decoded.notes)
        if received.conflicts:
            notes.append(f"{received.conflicts} frames disagreed with others of this image")
        return _record(received, decoded, codec, notes)

    def coded_image(self, received: ReceivedImage, image: ReconstructedImage) -> CodedImage:
        """Return the coded image of an image that was decoded: its content, its codebook and the CRC of its pixels."""
        needs_tiles = bool(image.codec) and default_registry().spec(image.codec).needs_tiles
        return CodedImage(
            **{name: getattr(received, name) for name in ReceivedImage.model_fields},
            codec=image.codec,
            model=image.model[:MODEL_DIGITS] if needs_tiles else "",
            pixels_crc32=zlib.crc32(image.pixels.data),
        )

    def _codec(self, received: ReceivedImage, further: Codebook | None) -> Codec:
        header = StreamHeader.unpack(received.stream)
        registry = default_registry()
        tiles: TileDatabase | None = None
        # The tag of a codec without tiles identifies another kind of model, or none.
        if registry.spec_for_id(header.codec_id).needs_tiles:
            named = received.model if isinstance(received, CodedImage) else ""
            codebook = self._codebooks.get(named or self._by_tag.get(header.model_tag, ""))
            if further is not None and further.tiles.identity.startswith(named or "-"):
                codebook = further
            if codebook is None:
                known = ", ".join(f"{tag:#06x}" for tag in self._by_tag)
                raise MissingCodebookError(f"image {received.image_id}", named, header.model_tag, known)
            tiles = codebook.tiles
        return registry.create_for_stream(received.stream, CodecResources(tiles))


def _record(
    received: ReceivedImage, decoded: DecodedImage, codec: Codec | None, notes: Sequence[str]
) -> ReconstructedImage:
    pixels = Pixels.from_array(decoded.image)
    if isinstance(received, CodedImage) and received.pixels_crc32 not in (None, zlib.crc32(pixels.data)):
        notes = [*notes, OTHER_PIXELS]
    return ReconstructedImage(
        vessel_id=received.vessel_id,
        vehicle_id=received.vehicle_id,
        image_id=received.image_id,
        version=received.version,
        contact=received.contact,
        codec=codec.name if codec else "",
        model=codec.model_hash if codec else "",
        pixels=pixels,
        pixels_sha256=pixels.sha256,
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
