"""Puts together what arrives by sound, decodes it, keeps the pictures and gives them on as they refine."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping

from sonarpost import keys, wire
from sonarpost.archive.image_files import write_image
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import InboxItem
from sonarpost.errors import BadInputError, ConfigError, DeliveryError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import Direction
from sonarpost.link.receiver import FrameRejected, ImageUpdate
from sonarpost.link.state import SavedParts
from sonarpost.logs import kv, log_context
from sonarpost.messages import AcousticFrame, ReconstructedImage, Record
from sonarpost.runtime.service import RETRY_AFTER_S, Service, UnitOfWork
from sonarpost.security.acoustic_key import read_key
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.decoder import Decoder
from sonarpost.services.decompressor.hearing import FrameReceivers

log = logging.getLogger(__name__)

_PARTS = "receivers/"
POLL_S = 0.2
QUIET_S = 2.0
"""No image's time is up before frames have stopped coming for this long, twice the longest pause of a hand-over."""


class DecompressorService(Service[DecompressorConfig]):
    """The operator's side of the codec.

    The receiver's state (which image waits for which bytes) is kept in the same transaction as the frame that
    changed it, so a process killed at any moment goes on as if nothing had happened.

    Raises:
        CodebookError: A configured codebook cannot be read.
        ConfigError: The key file cannot be read or is not the owner's alone, or nothing could be understood with it.
    """

    NAME = "decompressor"

    def __init__(self, platform: PlatformConfig, config: DecompressorConfig) -> None:
        # Before the store is opened: what is wrong with the configuration leaves nothing open behind it.
        self._decoder = Decoder(platform.id, config.codebooks)
        self._key = None if platform.acoustic_key_file is None else read_key(platform.acoustic_key_file)
        if self._key is not None and "v1" not in config.wire_formats:
            raise ConfigError(
                "[decompressor]",
                "wire_formats",
                config.wire_formats,
                '"v1" where acoustic_key_file is set',
            )
        super().__init__(platform, config)
        self._hearing = self._new_hearing()
        self._saved_parts = SavedParts({})
        self._pairing_problem = ""
        self._last_frame_s = time.monotonic()
        # One thread handles frames, another the waiting time; the receiver belongs to whoever holds the lock.
        self._lock = threading.Lock()
        self._in_step = False

    def _new_hearing(self) -> FrameReceivers:
        # It seals nothing: its address, which counters belong to, is of no account.
        seal = None if self._key is None else FrameAuthenticator(self._key, 0, Direction.TO_VEHICLE)
        return FrameReceivers(self.config.wire_formats, self.config.pairing_timeout_s, seal)

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Frames this vessel's modem received."""
        return {keys.acoustic_rx(self.platform.id): AcousticFrame}

    def on_start(self) -> None:
        """Start to watch the waiting time."""
        self._last_frame_s = time.monotonic()
        self.start_thread(self._watch_deadlines, "pairing")

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Give a frame to the receiver and act on what follows."""
        assert isinstance(record, AcousticFrame)
        self._last_frame_s = time.monotonic()
        self._load()
        self._follow(self._hearing.accept(record.source, record.data, record.time_utc_s), effects)

    def commit(self, effects: UnitOfWork, item: InboxItem | None = None) -> None:
        """Commit; only then does the receiver in memory stand for the one on the disk."""
        super().commit(effects, item)
        self._in_step = True

    def _handle_item(self, item: InboxItem) -> None:
        with self._lock:
            super()._handle_item(item)

    def _load(self) -> None:
        """Go back to the last committed state when memory may be ahead of it."""
        if not self._in_step:
            self._hearing = self._new_hearing()
            names = self.store.state_names(_PARTS)
            parts = {name.removeprefix(_PARTS): self.store.get_state(name) or b"" for name in names}
            self._saved_parts = SavedParts(parts)
            old = {n: state for n in FrameReceivers.OLD_STATES if (state := self.store.get_state(n)) is not None}
            errors = self._hearing.restore(parts) if parts or not old else self._hearing.restore_old(old)
            for name, reason in errors.items():
                log.error(
                    "Discarding an unreadable part of the receivers' state", extra=kv(part=name, reason=str(reason))
                )
        self._in_step = False

    def _watch_deadlines(self) -> None:
        while not self.stopping.wait(POLL_S):
            try:
                with self._lock:
                    self._poll()
            except (OSError, DeliveryError) as error:
                # Not `problem`: the thread that handles frames says through it that frames can be handled.
                self._pairing_problem = f"{type(error).__name__}: {error}"
                log.exception("Picture not given out, trying again")
                self.stopping.wait(RETRY_AFTER_S)

    def degraded_reason(self) -> str:
        """Return what keeps pictures whose time is up from being given out."""
        return self._pairing_problem

    def _poll(self) -> None:
        if self.store.inbox_depth() or time.monotonic() - self._last_frame_s < QUIET_S:
            # After an outage, frames that were heard in time come in one after the other. While they do, it is their
            # own times by which the receiver ends the waiting.
            return
        self._load()
        effects = UnitOfWork()
        events = self._hearing.poll(time.time())
        if events:
            self._follow(events, effects)
            self.commit(effects)
        self._in_step = True
        self._pairing_problem = ""

    def _follow(self, events: Iterable[ImageUpdate | FrameRejected], effects: UnitOfWork) -> None:
        for event in events:
            if isinstance(event, FrameRejected):
                effects.count("frames_rejected")
                log.warning("Frame rejected", extra=kv(source=event.source, reason=str(event.reason)))
            else:
                self._give_out(event, effects)
        parts = self._hearing.parts()
        for name, data in self._saved_parts.changes(parts).items():
            if data is None:
                effects.delete_state(_PARTS + name)
            else:
                effects.put_state(_PARTS + name, data)
        for name in FrameReceivers.OLD_STATES:
            effects.delete_state(name)
        self._saved_parts.commit(parts)

    def _give_out(self, event: ImageUpdate, effects: UnitOfWork) -> None:
        vehicle = self.config.vehicles.get(str(event.source), f"modem-{event.source}")
        with log_context(vehicle=vehicle, image_id=event.image_id):
            self._give_out_of(event, vehicle, effects)

    def _give_out_of(self, event: ImageUpdate, vehicle: str, effects: UnitOfWork) -> None:
        try:
            image = self._decode(event, vehicle)
        except BadInputError as error:
            log.error("Image cannot be decoded", extra=kv(reason=str(error)))
            self._keep_apart_image(event, vehicle, str(error), effects)
            return
        except Exception as error:
            # A defect of ours would meet the same image again at every start.
            log.exception("Image not decoded")
            self._keep_apart_image(event, vehicle, f"{type(error).__name__}: {error}", effects)
            return
        path, _ = write_image(self.config.out_dir, image)
        payload, key = wire.encode(image), keys.image_reconstructed(self.platform.id)
        for consumer in self.config.image_consumers:
            effects.send_payload(key, consumer, payload, ReconstructedImage, priority=5)
        effects.count("images_reconstructed")
        effects.count("images_complete", int(image.complete))
        log.info(
            "Picture reconstructed",
            extra=kv(
                version=image.version,
                missing_percent=round(100 * image.missing_fraction, 1),
                missing_halves=",".join(image.missing_halves),
                file=path,
            ),
        )

    def _keep_apart_image(self, event: ImageUpdate, vehicle: str, reason: str, effects: UnitOfWork) -> None:
        effects.count("images_undecodable")
        effects.quarantine(f"image {vehicle}/{event.image_id}", event.stream, reason)

    def _decode(self, event: ImageUpdate, vehicle: str) -> ReconstructedImage:
        return self._decoder.image(event, vehicle)

    def gauges(self) -> Mapping[str, float]:
        """Return whether an image of the paper's format still waits for something."""
        return {"images_waiting": float(self._hearing.paper.next_deadline() is not None)}
