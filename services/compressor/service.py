"""Turns snippets into codec streams, each with the identifier it has on the acoustic link, and gives them again."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import replace

from sonarpost import keys, wire
from sonarpost.codec.interface import Codec
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.config import PlatformConfig
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.link.frames.v1.preview import MAX_NUMBER
from sonarpost.logs import kv
from sonarpost.messages import Command, CommandKind, EncodedImage, Record, Snippet
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.kept import CachedImage, EncodeCache
from sonarpost.services.compressor.refine import encode, handed, refined
from sonarpost.services.compressor.wide import wider

log = logging.getLogger(__name__)

IMAGE_IDS = MAX_NUMBER
"""Identifiers count from 0001 as contacts do on the v1 link, so that both ends call a picture the same."""
_NEXT_IMAGE = "next_image"
_ASKED_FOR = 3
"""Priority of what the vessel has asked for."""


class CompressorService(Service[CompressorConfig]):
    """Encodes every snippet once.

    Raises:
        CodebookError: The codebook cannot be read.
        ConfigError: No such codec.
    """

    NAME = "compressor"

    def __init__(self, platform: PlatformConfig, config: CompressorConfig) -> None:
        # Before the store is opened: what is wrong with the configuration leaves nothing open behind it.
        tiles = open_codebook(config.codebook).tiles
        self._codec: Codec = default_registry().create(config.codec, CodecResources(tiles, config.packing))
        super().__init__(platform, config)
        self._kept = EncodeCache(self.store, config.cache_images, config.cache_s)
        log.info("Codec ready", extra=kv(codec=self._codec.name, model=self._codec.model_hash[:16]))

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Snippets of this vehicle, and what the vessel asks of pictures."""
        commands = {keys.command(self.platform.id, kind): Command for kind in ("refine", "resend", "wider")}
        return {keys.contact_detected(self.platform.id): Snippet, **commands}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Encode a snippet, or a picture again, and owe the stream to uuv_modem."""
        if isinstance(record, Command):
            self._answer(record, effects)
            return
        assert isinstance(record, Snippet)
        image_id, kept = self._encode(record, effects, effects.payload)
        if self.config.cache_images:
            self._kept.keep(effects, {image_id: kept}, time.time())

    def _encode(
        self, snippet: Snippet, effects: UnitOfWork, payload: bytes, priority: int = 4
    ) -> tuple[str, CachedImage]:
        """Owe uuv_modem the stream of a new picture; return its identifier and what may be kept of it.

        Args:
            snippet: The picture.
            effects: Takes what it leads to.
            payload: The snippet, packed.
            priority: Of the hand-over.
        """
        started = time.perf_counter()
        whole = encode(self._codec, snippet.picture.to_array(), self.config.budget_bytes, self.config.refine_bytes)
        stream = handed(self._codec, whole)
        number = self._next_number()
        effects.put_state(_NEXT_IMAGE, str(number % IMAGE_IDS + 1).encode())
        image = EncodedImage(
            vehicle_id=self.platform.id,
            image_id=format_image_id(number),
            contact=snippet.contact,
            codec=self._codec.name,
            model=self._codec.model_hash,
            height_px=snippet.picture.height_px,
            width_px=snippet.picture.width_px,
            stream=stream,
            original_sha256=snippet.picture.sha256,
        )
        effects.send(keys.image_encoded(self.platform.id), "uuv_modem", image, priority=priority)
        effects.count("images_encoded")
        effects.count("bytes_encoded", len(stream))
        log.info(
            "Picture encoded",
            extra=kv(
                vehicle=image.vehicle_id,
                contact_id=snippet.contact.contact_id,
                image_id=image.image_id,
                pixels=f"{image.height_px}x{image.width_px}",
                bytes=len(stream),
                encode_ms=round(1000 * (time.perf_counter() - started), 1),
            ),
        )
        return image.image_id, CachedImage(wire.encode(image.model_copy(update={"stream": whole})), payload)

    def _answer(self, command: Command, effects: UnitOfWork) -> None:
        """Give a picture again, finer or wider where that was asked for."""
        image_id = command.image_id or ""
        found = self._kept.find(image_id)
        if found is None:
            effects.count("commands_unknown_image")
            log.warning("Picture is not kept any more", extra=kv(image_id=image_id, kind=command.kind))
        elif command.kind == "wider":
            self._widen(image_id, found, effects)
        else:
            self._give_again(command.kind, image_id, found, effects)

    def _widen(self, image_id: str, found: CachedImage, effects: UnitOfWork) -> None:
        """Give more of the seabed around a contact as a picture of its own, the same one whenever it is asked for."""
        before = self._kept.find(found.wider_id) if found.wider_id else None
        if before is not None:
            self._give_again("resend", found.wider_id, before, effects)
            return
        wide = wider(wire.decode(Snippet, found.snippet, _where(image_id)))
        if wide is None:
            effects.count("commands_nothing_wider")
            log.warning("There is no wider picture", extra=kv(image_id=image_id))
            return
        wider_id, kept = self._encode(wide, effects, wire.encode(wide), priority=_ASKED_FOR)
        self._kept.keep(effects, {image_id: replace(found, wider_id=wider_id), wider_id: kept}, time.time())
        effects.count("images_widened")
        log.info("Wider picture given", extra=kv(image_id=image_id, wider_id=wider_id))

    def _give_again(self, kind: CommandKind, image_id: str, found: CachedImage, effects: UnitOfWork) -> None:
        """Give a picture again; finer where that was asked for and its stream can go on where it ended.

        What a stream has more than the link has sent of it, the link sends by itself: this is for what it has not.
        """
        image = wire.decode(EncodedImage, found.image, _where(image_id))
        # A picture that was encoded before the codec was changed goes as it is.
        is_ours = (image.codec, image.model) == (self._codec.name, self._codec.model_hash)
        if kind == "refine" and is_ours:
            snippet = wire.decode(Snippet, found.snippet, _where(image_id))
            longer = refined(self._codec, image.stream, snippet.picture.to_array())
            if longer != image.stream:
                image = image.model_copy(update={"stream": longer})
                self._kept.keep(effects, {image_id: replace(found, image=wire.encode(image))}, time.time())
                effects.count("images_refined")
        if is_ours:
            image = image.model_copy(update={"stream": handed(self._codec, image.stream)})
        effects.send(keys.image_encoded(self.platform.id), "uuv_modem", image, priority=_ASKED_FOR)
        effects.count("images_given_again")
        log.info("Picture given again", extra=kv(image_id=image_id, kind=kind, bytes=len(image.stream)))

    def _next_number(self) -> int:
        """Return the next image number.

        The first is drawn from the store's own identity, so that a vehicle whose disk was wiped does not begin with
        the identifiers of its last mission, which the vessel still remembers.
        """
        kept = self.store.get_state(_NEXT_IMAGE)
        first = int.from_bytes(self.store.origin[:4], "big") if kept is None else int(kept)
        return (first - 1) % IMAGE_IDS + 1


def _where(image_id: str) -> str:
    return f"compressor.db: kept/{image_id}"
