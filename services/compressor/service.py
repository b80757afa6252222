"""The compressor service: encodes snippets and answers refine, resend, expand, original and region commands."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.codec.interface import Codec
from sonarpost.codec.jit import use_code_folder
from sonarpost.codec.region import RegionBox
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.config import PlatformConfig
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.link.frames.v1.payload_objects import MAX_NUMBER
from sonarpost.logs import kv
from sonarpost.messages import Command, CommandKind, EncodedImage, Record, Snippet
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.encode_cache import CachedImage, EncodeCache
from sonarpost.services.compressor.encoding import (
    cut_region,
    encode,
    expand,
    is_despeckled,
    refine,
    transmit_part,
)

log = logging.getLogger(__name__)

IMAGE_IDS = MAX_NUMBER
"""Image identifiers are the image numbers of the v1 link, 1 to this."""
_KINDS: Final[tuple[CommandKind, ...]] = ("refine", "resend", "expand", "original", "region")
_CONSUMER = "uuv_modem"
_NEXT_IMAGE = "next_image"
QUICK_PIXELS: Final = 32_768
"""Size of an image that is encoded while its sender waits: less than a second on a slow computer."""
_COMMAND_PRIORITY = 3
"""Delivery priority of images that the vessel has requested."""


class CompressorService(Service[CompressorConfig]):
    """Encodes each snippet once and assigns its image identifier.

    Raises:
        CodebookError: The codebook cannot be read.
        ConfigError: Unknown codec.
    """

    NAME = "compressor"
    MAX_AT_ONCE = 1

    def __init__(self, platform: PlatformConfig, config: CompressorConfig) -> None:
        use_code_folder(platform.state_dir)
        # Before the store is opened, so that a configuration error leaves no open store.
        self._tiles = open_codebook(config.codebook).tiles
        resources = CodecResources(self._tiles, config.packing, config.model, strength=config.despeckle_strength)
        self._codec: Codec = default_registry().create(config.codec, resources)
        self._codec_without_despeckling: Codec = default_registry().create(
            config.codec, replace(resources, strength=0.0)
        )
        super().__init__(platform, config)
        self._is_compiled = False
        self._cache = EncodeCache(self.store, config.cache_images)
        log.info("Codec ready", extra=kv(codec=self._codec.name, model=self._codec.model_hash[:16]))

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return the keys of this vehicle's snippets, and of commands for its images."""
        commands = {keys.command(self.platform.id, kind): Command for kind in _KINDS}
        return {keys.contact_detected(self.platform.id): Snippet, **commands}

    @override
    def is_quick(self, record: Record) -> bool:
        """Return whether a record is a small snippet, and not the first one, which may compile the codec."""
        return (
            self._is_compiled
            and isinstance(record, Snippet)
            and record.pixels.height_px * record.pixels.width_px <= QUICK_PIXELS
        )

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Encode a snippet, or execute a command, and send the stream to uuv_modem."""
        if isinstance(record, Command):
            self._execute(record, effects)
            return
        assert isinstance(record, Snippet)
        image_id, cached = self._encode(record, effects, effects.payload, self._codec)
        self._is_compiled = True
        if self.config.cache_images:
            self._cache.put(effects, {image_id: cached})

    def _encode(
        self,
        snippet: Snippet,
        effects: UnitOfWork,
        payload: bytes,
        codec: Codec,
        priority: int = 4,
        budget_bytes: int | None = None,
    ) -> tuple[str, CachedImage]:
        """Encode a snippet as a new image and send it; return its identifier and cache entry.

        Args:
            snippet: The snippet.
            effects: Receives the record.
            payload: The snippet, encoded.
            codec: The codec, with or without despeckling.
            priority: Delivery priority.
            budget_bytes: Maximum length of the part that is sent; None for the configured one.
        """
        started = time.perf_counter()
        budget = self.config.budget_bytes if budget_bytes is None else budget_bytes
        # A region is sent as long as the command says: the link sends up to its `stream_bytes` without a command.
        refine_bytes = self.config.refine_bytes if budget_bytes is None else 0
        complete = encode(codec, snippet.pixels.to_array(), budget, refine_bytes)
        stream = transmit_part(codec, complete)
        number = self._next_number()
        effects.put_state(_NEXT_IMAGE, str(number % IMAGE_IDS + 1).encode())
        cached = CachedImage(codec.name, codec.model_hash, complete, payload, snippet)
        image = self._image(format_image_id(number), cached, stream)
        effects.send(keys.image_encoded(self.platform.id), _CONSUMER, image, priority=priority)
        effects.count("images_encoded")
        effects.count("bytes_encoded", len(stream))
        log.info(
            "Image encoded",
            extra=kv(
                vehicle=image.vehicle_id,
                contact_id=snippet.contact.contact_id,
                image_id=image.image_id,
                pixels=f"{image.width_px}x{image.height_px}",
                bytes=len(stream),
                # Codecs without despeckling do not have this attribute.
                despeckle_strength=getattr(codec, "strength", 0.0),
                encode_ms=round(1000 * (time.perf_counter() - started), 1),
            ),
        )
        return image.image_id, cached

    def _image(self, image_id: str, cached: CachedImage, stream: bytes) -> EncodedImage:
        """Return the record of an image with a part of its stream."""
        snippet = cached.snippet
        return EncodedImage(
            vehicle_id=self.platform.id,
            image_id=image_id,
            contact=snippet.contact,
            codec=cached.codec,
            model=cached.model,
            height_px=snippet.pixels.height_px,
            width_px=snippet.pixels.width_px,
            stream=stream,
            original_sha256=snippet.pixels.sha256,
        )

    def _execute(self, command: Command, effects: UnitOfWork) -> None:
        image_id = command.image_id or ""
        cached = self._cache.get(image_id)
        if cached is None:
            effects.count("commands_unknown_image")
            log.warning("Image of command not in cache", extra=kv(image_id=image_id, kind=command.kind))
        elif command.kind == "expand":
            self._expand(image_id, cached, effects)
        elif command.kind == "original":
            self._send_original(image_id, cached, effects)
        elif command.kind == "region":
            self._send_region(command, cached, effects)
        else:
            self._resend(command.kind, image_id, cached, effects)

    def _expand(self, image_id: str, cached: CachedImage, effects: UnitOfWork) -> None:
        """Send more seabed around a contact as an image of its own; a repeated command sends the same image."""
        if self._resend_derived(cached.expanded_id, effects):
            return
        snippet = expand(cached.snippet)
        if snippet is None:
            effects.count("commands_without_expanded_image")
            log.warning("Snippet has no expanded image", extra=kv(image_id=image_id))
            return
        expanded_id, entry = self._encode(
            snippet, effects, wire.encode(snippet), self._codec, priority=_COMMAND_PRIORITY
        )
        self._cache.put(effects, {image_id: replace(cached, expanded_id=expanded_id), expanded_id: entry})
        effects.count("images_expanded")
        log.info("Expanded image sent", extra=kv(image_id=image_id, expanded_id=expanded_id))

    def _resend_derived(self, image_id: str, effects: UnitOfWork) -> bool:
        """Send an image again that was made of another one; return False if none was made or it is not cached."""
        cached = self._cache.get(image_id) if image_id else None
        if cached is not None:
            self._resend("resend", image_id, cached, effects)
        return cached is not None

    def _send_original(self, image_id: str, cached: CachedImage, effects: UnitOfWork) -> None:
        """Send a contact without despeckling as an image of its own; a repeated command sends the same image."""
        if self._resend_derived(cached.original_id, effects):
            return
        if not is_despeckled(cached.stream):
            effects.count("commands_without_despeckling")
            log.warning("Image is not despeckled", extra=kv(image_id=image_id, codec=cached.codec))
            return
        original_id, entry = self._encode(
            cached.snippet, effects, cached.payload, self._codec_without_despeckling, priority=_COMMAND_PRIORITY
        )
        self._cache.put(effects, {image_id: replace(cached, original_id=original_id), original_id: entry})
        effects.count("images_original")
        log.info("Image without despeckling sent", extra=kv(image_id=image_id, original_id=original_id))

    def _send_region(self, command: Command, cached: CachedImage, effects: UnitOfWork) -> None:
        """Send a part of an image, coded alone with all bytes, as an image of its own."""
        assert command.box is not None
        assert command.stream_bytes is not None
        image_id = command.image_id or ""
        region = cut_region(cached.snippet, RegionBox(*command.box))
        region_id, entry = self._encode(
            region,
            effects,
            wire.encode(region),
            self._codec if is_despeckled(cached.stream) else self._codec_without_despeckling,
            priority=_COMMAND_PRIORITY,
            budget_bytes=command.stream_bytes,
        )
        self._cache.put(effects, {region_id: entry})
        effects.count("images_region")
        log.info("Region sent", extra=kv(image_id=image_id, region_id=region_id, bytes=command.stream_bytes))

    def _resend(self, kind: CommandKind, image_id: str, cached: CachedImage, effects: UnitOfWork) -> None:
        """Send an image again, with a longer stream for a refine command if the codec can extend it.

        The link itself sends the rest of a stream that it has; a command arrives here only when it has no more.
        """
        # An image that was encoded with another codec is sent unchanged.
        codec = self._codec_of(cached)
        if kind == "refine" and codec is not None:
            longer = refine(codec, cached.stream, cached.snippet.pixels.to_array())
            if longer != cached.stream:
                cached = replace(cached, stream=longer)
                self._cache.put(effects, {image_id: cached})
                effects.count("images_refined")
        stream = cached.stream if codec is None else transmit_part(codec, cached.stream)
        image = self._image(image_id, cached, stream)
        effects.send(keys.image_encoded(self.platform.id), _CONSUMER, image, priority=_COMMAND_PRIORITY)
        effects.count("images_resent")
        log.info("Image sent again", extra=kv(image_id=image_id, kind=kind, bytes=len(image.stream)))

    def _codec_of(self, cached: CachedImage) -> Codec | None:
        """Return the codec that continues the stream of a cached image, with the model that began it.

        The configuration may have changed since: model and strength of despeckling are those of the stream. None for
        an image of another codec than the configured one, or of a model or codebook that this installation lacks.
        """
        if cached.codec != self._codec.name:
            return None
        codec = default_registry().create_for_stream(cached.stream, CodecResources(self._tiles))
        return codec if codec.model_hash == cached.model else None

    def _next_number(self) -> int:
        """Return the next image number.

        The first is derived from the identity of the store. A vehicle with a new disk therefore does not begin with
        the identifiers of its last mission, which the vessel may still have.
        """
        number = self.store.read_state(_NEXT_IMAGE, int, int.from_bytes(self.store.origin[:4], "big"))
        return (number - 1) % IMAGE_IDS + 1
