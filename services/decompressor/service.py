"""decompressor: decodes received images, writes their files, sends pixels to the console and streams to the relay."""

from __future__ import annotations

import hashlib
import logging
import math
import time
import uuid
from collections.abc import Mapping
from typing import Any

import zenoh
from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.archive.codebook_transfer import declare_codebooks
from sonarpost.archive.decoder import Decoder
from sonarpost.archive.image_files import remove_old_images, write_image
from sonarpost.codec.jit import use_code_folder
from sonarpost.config import PlatformConfig
from sonarpost.delivery.protocol import attachment
from sonarpost.delivery.records import OutboxItem
from sonarpost.errors import BadInputError, PayloadError
from sonarpost.logs import kv
from sonarpost.messages import ReceivedImage, ReconstructedImage, Record
from sonarpost.runtime.retention import Retention
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.decompressor.config import DecompressorConfig

log = logging.getLogger(__name__)

STREAM_CONSUMER = "relay"
"""The consumer that gets the coded stream: the link to the shore site carries no pixels."""
WATCHERS = "watchers"
QUICK_PIXELS = 32_768
"""Size of an image that is decoded while its sender waits: less than a second on a slow computer."""
SUBSCRIBERS_UNKNOWN_S = 1.0
"""Time after the start in which the router may not have reported all subscribers: pixels are published."""


class DecompressorService(Service[DecompressorConfig]):
    """The decoder of the vessel. It has no state except the records that it has not handled or sent.

    Raises:
        CodebookError: A configured codebook cannot be read.
    """

    NAME = "decompressor"
    PAGE_BYTES = 512
    MAX_AT_ONCE = 1

    def __init__(self, platform: PlatformConfig, config: DecompressorConfig) -> None:
        use_code_folder(platform.state_dir)
        # Before the store is opened, so that a configuration error leaves no open store.
        self._decoder = Decoder(config.codebooks)
        super().__init__(platform, config)
        self._is_compiled = False
        self._retention = Retention(self._apply_retention, self.stopping)
        self._copy_origin, self._copies = uuid.uuid4().bytes, 0
        self._publisher: zenoh.Publisher | None = None
        self._subscribers_known_s = math.inf

    @override
    def on_start(self) -> None:
        """Start the retention, and reply to queries for codebooks."""
        key, encoding = keys.image_reconstructed(self.platform.id), wire.encoding_of(ReconstructedImage)
        self._publisher = self.session.declare_publisher(key, encoding=encoding)
        self._subscribers_known_s = time.monotonic() + SUBSCRIBERS_UNKNOWN_S
        declare_codebooks(self.session, self.platform.id, self._decoder)
        self.start_thread(self._retention.run, "retention")

    @override
    def on_stop(self) -> None:
        """End the retention."""
        self._retention.wake()

    @override
    def degraded_reason(self) -> str:
        """Return why old files cannot be removed."""
        return self._retention.error

    def _apply_retention(self, now_utc_s: float) -> None:
        config = self.config
        removed = remove_old_images(config.out_dir, now_utc_s, config.retain_days, config.max_bytes)
        if removed:
            self.count("images_removed", len(removed))
            log.warning("Image files removed by retention", extra=kv(images=len(removed), first=removed[0]))

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Return the coded images of this vessel."""
        return {keys.acoustic_image(self.platform.id): ReceivedImage}

    @override
    def validate(self, key: str, record: Record) -> None:
        """Reject an image of another vessel."""
        assert isinstance(record, ReceivedImage)
        if record.vessel_id != self.platform.id:
            raise PayloadError(key, "vessel_id", record.vessel_id, self.platform.id)

    @override
    def is_quick(self, record: Record) -> bool:
        """Return whether an image is small, and not the first one, which may compile the codec."""
        assert isinstance(record, ReceivedImage)
        return self._is_compiled and (record.height_px or 0) * (record.width_px or 0) <= QUICK_PIXELS

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Decode an image, write its files and send it; quarantine the stream if it cannot be decoded."""
        assert isinstance(record, ReceivedImage)
        try:
            image = self._decoder.decode(record)
            self._is_compiled = True
        except BadInputError as error:
            log.error("Image cannot be decoded", extra=kv(reason=str(error)))
            self._quarantine_stream(record, str(error), effects)
            return
        except Exception as error:
            # An unexpected exception must cost this image only; the record would raise it again.
            log.exception("Image quarantined after an unexpected exception")
            self._quarantine_stream(record, f"{type(error).__name__}: {error}", effects)
            return
        written = write_image(self.config.out_dir, image)
        if written.is_new and written.is_conflict:
            log.warning(
                "Image conflicts with a stored one of the same name; both are kept", extra=kv(file=written.tiff)
            )
            effects.count("images_conflicting")
        for consumer in self.config.image_consumers:
            if consumer == STREAM_CONSUMER:
                coded = self._decoder.coded_image(record, image)
                effects.send(keys.image_coded(self.platform.id), consumer, coded, priority=5)
            else:
                effects.send(keys.image_reconstructed(self.platform.id), consumer, image, priority=5)
        if not set(self.config.image_consumers) - {STREAM_CONSUMER}:
            self._publish_copy(image)
        effects.count("images_reconstructed")
        effects.count("images_complete", int(image.complete))
        log.info(
            "Image decoded",
            extra=kv(
                version=image.version,
                missing_percent=round(100 * image.missing_fraction, 1),
                missing_halves=",".join(image.missing_halves),
                file=written.tiff,
            ),
        )

    def _publish_copy(self, image: ReconstructedImage) -> None:
        """Publish the pixels if there is a subscriber; the attachment marks a copy, which no consumer accepts."""
        if time.monotonic() > self._subscribers_known_s:
            assert self._publisher is not None
            status: Any = self._publisher.matching_status  # the stub of Zenoh says bool
            if not status.matching:
                return
        payload, key = wire.encode(image), keys.image_reconstructed(self.platform.id)
        encoding = wire.encoding_of(ReconstructedImage)
        self._copies += 1
        item = OutboxItem(WATCHERS, self._copies, key, encoding, 5, payload, hashlib.sha256(payload).digest())
        try:
            self.session.put(key, payload, encoding=encoding, attachment=attachment(self._copy_origin, item))
        except zenoh.ZError as error:
            log.warning("Image not published", extra=kv(error=str(error)))

    def _quarantine_stream(self, received: ReceivedImage, reason: str, effects: UnitOfWork) -> None:
        effects.count("images_undecodable")
        effects.quarantine(f"image {received.vehicle_id}/{received.image_id}", received.stream, reason)
