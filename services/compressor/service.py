"""Turns snippets into codec streams and gives each the four-character identifier it has on the acoustic link."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

from services.compressor.config import CompressorConfig
from sonarpost import keys
from sonarpost.catalogue.store import open_catalogue
from sonarpost.codec.interface import Codec
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.link.paper_format import format_image_id
from sonarpost.messages import EncodedImage, Record, Snippet
from sonarpost.runtime.config import PlatformConfig
from sonarpost.runtime.logs import kv
from sonarpost.runtime.service import Effects, Service

log = logging.getLogger(__name__)

IMAGE_IDS = 36**4
_NEXT_IMAGE = "next_image"


class CompressorService(Service[CompressorConfig]):
    """Encodes every snippet once.

    Raises:
        CatalogueError: The catalogue cannot be read.
        ConfigError: No such codec.
    """

    NAME = "compressor"

    def __init__(self, platform: PlatformConfig, config: CompressorConfig) -> None:
        # Before the store is opened: what is wrong with the configuration leaves nothing open behind it.
        tiles = open_catalogue(config.catalogue).tiles
        self._codec: Codec = default_registry().create(config.codec, CodecResources(tiles, config.packing))
        super().__init__(platform, config)
        log.info("Codec ready", extra=kv(codec=self._codec.name, model=self._codec.model_hash[:16]))

    def consumes(self) -> Mapping[str, type[Record]]:
        """Snippets of this vehicle."""
        return {keys.contact_detected(self.platform.id): Snippet}

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Encode a snippet and owe the stream to uuv_modem."""
        assert isinstance(record, Snippet)
        started = time.perf_counter()
        stream = self._codec.encode(record.picture.to_array(), self.config.budget_bytes or None)
        number = self._next_number()
        effects.put_state(_NEXT_IMAGE, str((number + 1) % IMAGE_IDS).encode())
        image = EncodedImage(
            vehicle_id=self.platform.id,
            image_id=format_image_id(number),
            contact=record.contact,
            codec=self._codec.name,
            model=self._codec.model_hash,
            height_px=record.picture.height_px,
            width_px=record.picture.width_px,
            stream=stream,
            original_sha256=record.picture.sha256,
        )
        effects.send(keys.image_encoded(self.platform.id), "uuv_modem", image)
        effects.count("images_encoded")
        effects.count("bytes_encoded", len(stream))
        log.info(
            "Picture encoded",
            extra=kv(
                contact=record.contact.contact_id,
                image_id=image.image_id,
                pixels=f"{image.height_px}x{image.width_px}",
                bytes=len(stream),
                encode_ms=round(1000 * (time.perf_counter() - started), 1),
            ),
        )

    def _next_number(self) -> int:
        """Return the next image number.

        The first is drawn from the store's own identity, so that a vehicle whose disk was wiped does not begin with
        the identifiers of its last mission, which the vessel still remembers.
        """
        kept = self.store.get_state(_NEXT_IMAGE)
        return int(kept) if kept is not None else int.from_bytes(self.store.origin[:4], "big") % IMAGE_IDS
