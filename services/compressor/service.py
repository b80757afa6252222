"""Turns snippets into codec streams, each with the identifier it has on the acoustic link, and gives them again."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

from services.compressor.config import CompressorConfig
from services.compressor.kept import KeptPictures
from services.compressor.refine import encode, handed, refined
from sonarpost import keys, wire
from sonarpost.catalogue.store import open_catalogue
from sonarpost.codec.interface import Codec
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.link.paper_format import format_image_id
from sonarpost.link.v1_preview import MAX_NUMBER
from sonarpost.messages import Command, EncodedImage, Record, Snippet
from sonarpost.runtime.config import PlatformConfig
from sonarpost.runtime.logs import kv
from sonarpost.runtime.service import Effects, Service

log = logging.getLogger(__name__)

IMAGE_IDS = MAX_NUMBER
"""Identifiers count from 0001 as contacts do on the v1 link, so that both ends call a picture the same."""
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
        self._kept = KeptPictures(self.store, config.keep_pictures, config.keep_s)
        log.info("Codec ready", extra=kv(codec=self._codec.name, model=self._codec.model_hash[:16]))

    def consumes(self) -> Mapping[str, type[Record]]:
        """Snippets of this vehicle, and what the vessel asks of pictures."""
        commands = {keys.command(self.platform.id, kind): Command for kind in ("refine", "resend")}
        return {keys.contact_detected(self.platform.id): Snippet, **commands}

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Encode a snippet, or a picture again, and owe the stream to uuv_modem."""
        if isinstance(record, Command):
            self._answer(record, effects)
            return
        assert isinstance(record, Snippet)
        started = time.perf_counter()
        whole = encode(self._codec, record.picture.to_array(), self.config.budget_bytes, self.config.refine_bytes)
        stream = handed(self._codec, whole)
        number = self._next_number()
        effects.put_state(_NEXT_IMAGE, str(number % IMAGE_IDS + 1).encode())
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
        if self.config.keep_pictures:
            kept = image.model_copy(update={"stream": whole})
            self._kept.keep(effects, image.image_id, wire.encode(kept), effects.payload, time.time())
        effects.count("images_encoded")
        effects.count("bytes_encoded", len(stream))
        log.info(
            "Picture encoded",
            extra=kv(
                vehicle=image.vehicle_id,
                contact_id=record.contact.contact_id,
                image_id=image.image_id,
                pixels=f"{image.height_px}x{image.width_px}",
                bytes=len(stream),
                encode_ms=round(1000 * (time.perf_counter() - started), 1),
            ),
        )

    def _answer(self, command: Command, effects: Effects) -> None:
        """Give a picture again; finer where that was asked for and its stream can go on where it ended.

        What a stream has more than the link has sent of it, the link sends by itself: this is for what it has not.
        """
        image_id = command.image_id or ""
        found = self._kept.find(image_id)
        if found is None:
            effects.count("commands_unknown_image")
            log.warning("Picture is not kept any more", extra=kv(image_id=image_id, kind=command.kind))
            return
        where = f"compressor.db: kept/{image_id}"
        image = wire.decode(EncodedImage, found[0], where)
        # A picture that was encoded before the codec was changed goes as it is.
        is_ours = (image.codec, image.model) == (self._codec.name, self._codec.model_hash)
        if command.kind == "refine" and is_ours:
            snippet = wire.decode(Snippet, found[1], where)
            longer = refined(self._codec, image.stream, snippet.picture.to_array())
            if longer != image.stream:
                image = image.model_copy(update={"stream": longer})
                self._kept.keep(effects, image_id, wire.encode(image), found[1], time.time())
                effects.count("images_refined")
        if is_ours:
            image = image.model_copy(update={"stream": handed(self._codec, image.stream)})
        effects.send(keys.image_encoded(self.platform.id), "uuv_modem", image, priority=3)
        effects.count("images_given_again")
        log.info("Picture given again", extra=kv(image_id=image_id, kind=command.kind, bytes=len(image.stream)))

    def _next_number(self) -> int:
        """Return the next image number.

        The first is drawn from the store's own identity, so that a vehicle whose disk was wiped does not begin with
        the identifiers of its last mission, which the vessel still remembers.
        """
        kept = self.store.get_state(_NEXT_IMAGE)
        first = int.from_bytes(self.store.origin[:4], "big") if kept is None else int(kept)
        return (first - 1) % IMAGE_IDS + 1
