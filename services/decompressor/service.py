"""Pairs the halves that arrive by sound, decodes them, keeps the pictures and gives them on."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterable, Mapping

import msgpack

from services.decompressor.config import DecompressorConfig
from services.decompressor.decoder import Decoder
from sonarpost import keys
from sonarpost.errors import BadInputError, HandoffError
from sonarpost.link.paper_events import ContactOnly, Event, FrameRejected, ImageReady
from sonarpost.link.paper_receiver import PairingReceiver
from sonarpost.messages import AcousticFrame, ReconstructedImage, Record
from sonarpost.runtime.config import PlatformConfig
from sonarpost.runtime.logs import kv
from sonarpost.runtime.picture_files import write_picture
from sonarpost.runtime.service import RETRY_AFTER_S, Effects, Service
from sonarpost.runtime.transaction import InboxItem

log = logging.getLogger(__name__)

_RECEIVER = "receiver"
POLL_S = 0.2
MEMORY_S = 6 * 3600.0
QUIET_S = 2.0
"""No image's time is up before frames have stopped coming for this long, twice the longest pause of a hand-over."""


class DecompressorService(Service[DecompressorConfig]):
    """The operator's side of the codec.

    The receiver's state (which image waits for which bytes) is kept in the same transaction as the frame that
    changed it, so a process killed at any moment goes on as if nothing had happened.

    Raises:
        CatalogueError: A configured catalogue cannot be read.
    """

    NAME = "decompressor"

    def __init__(self, platform: PlatformConfig, config: DecompressorConfig) -> None:
        # Before the store is opened: what is wrong with the configuration leaves nothing open behind it.
        self._decoder = Decoder(platform.id, config.catalogues)
        super().__init__(platform, config)
        self._receiver = self._new_receiver()
        self._pairing_problem = ""
        self._last_frame_s = time.monotonic()
        # One thread handles frames, another the waiting time; the receiver belongs to whoever holds the lock.
        self._lock = threading.Lock()
        self._in_step = False

    def _new_receiver(self) -> PairingReceiver:
        timeout_s = self.config.pairing_timeout_s
        return PairingReceiver(timeout_s, memory_s=max(MEMORY_S, timeout_s))

    def consumes(self) -> Mapping[str, type[Record]]:
        """Frames this vessel's modem received."""
        return {keys.acoustic_rx(self.platform.id): AcousticFrame}

    def on_start(self) -> None:
        """Start to watch the waiting time."""
        self._last_frame_s = time.monotonic()
        self.spawn(self._watch_deadlines, "pairing")

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Give a frame to the receiver and act on what follows."""
        assert isinstance(record, AcousticFrame)
        self._last_frame_s = time.monotonic()
        self._load()
        self._follow(self._receiver.accept(record.source, record.data, record.time_utc_s), effects)

    def commit(self, effects: Effects, item: InboxItem | None = None) -> None:
        """Commit; only then does the receiver in memory stand for the one on the disk."""
        super().commit(effects, item)
        self._in_step = True

    def _handle_item(self, item: InboxItem) -> None:
        with self._lock:
            super()._handle_item(item)

    def _load(self) -> None:
        """Go back to the last committed state when memory may be ahead of it."""
        if not self._in_step:
            kept = self.store.get_state(_RECEIVER)
            self._receiver = self._new_receiver()
            if kept is not None:
                self._receiver.restore(msgpack.unpackb(kept, strict_map_key=False))
        self._in_step = False

    def _watch_deadlines(self) -> None:
        while not self.stopping.wait(POLL_S):
            try:
                with self._lock:
                    self._poll()
            except (OSError, HandoffError) as error:
                # Not `problem`: the thread that handles frames says through it that frames can be handled.
                self._pairing_problem = f"{type(error).__name__}: {error}"
                log.exception("Picture not given out, trying again")
                self.stopping.wait(RETRY_AFTER_S)

    def trouble(self) -> str:
        """Return what keeps pictures whose time is up from being given out."""
        return self._pairing_problem

    def _poll(self) -> None:
        if self.store.inbox_depth() or time.monotonic() - self._last_frame_s < QUIET_S:
            # After an outage, frames that were heard in time come in one after the other. While they do, it is their
            # own times by which the receiver ends the waiting.
            return
        self._load()
        effects = Effects()
        events = self._receiver.poll(time.time())
        if events:
            self._follow(events, effects)
            self.commit(effects)
        self._in_step = True
        self._pairing_problem = ""

    def _follow(self, events: Iterable[Event], effects: Effects) -> None:
        for event in events:
            if isinstance(event, FrameRejected):
                effects.count("frames_rejected")
                log.warning("Frame rejected", extra=kv(source=event.source, reason=str(event.reason)))
            else:
                self._give_out(event, effects)
        effects.put_state(_RECEIVER, msgpack.packb(self._receiver.snapshot()))

    def _give_out(self, event: ImageReady | ContactOnly, effects: Effects) -> None:
        vehicle = self.config.vehicles.get(str(event.source), f"modem-{event.source}")
        try:
            image = self._decode(event, vehicle)
        except BadInputError as error:
            log.error("Image cannot be decoded", extra=kv(image_id=event.image_id, reason=str(error)))
            self._keep_apart_image(event, vehicle, str(error), effects)
            return
        except Exception as error:
            # A defect of ours would meet the same image again at every start.
            log.exception("Image not decoded", extra=kv(image_id=event.image_id))
            self._keep_apart_image(event, vehicle, f"{type(error).__name__}: {error}", effects)
            return
        path, _ = write_picture(self.config.out_dir, image)
        effects.send(keys.image_reconstructed(self.platform.id), "relay", image, priority=5)
        effects.count("images_reconstructed")
        effects.count("images_complete", int(image.complete))
        log.info(
            "Picture reconstructed",
            extra=kv(
                vehicle=vehicle,
                image_id=image.image_id,
                version=image.version,
                missing_percent=round(100 * image.missing_fraction, 1),
                missing_halves=",".join(image.missing_halves),
                file=path,
            ),
        )

    def _keep_apart_image(self, event: ImageReady | ContactOnly, vehicle: str, reason: str, effects: Effects) -> None:
        effects.count("images_undecodable")
        body = event.stream if isinstance(event, ImageReady) else b""
        effects.keep_apart(f"image {vehicle}/{event.image_id}", body, reason)

    def _decode(self, event: ImageReady | ContactOnly, vehicle: str) -> ReconstructedImage:
        if isinstance(event, ContactOnly):
            return self._decoder.contact_only(event, vehicle)
        return self._decoder.image(event, vehicle)

    def gauges(self) -> Mapping[str, float]:
        """Return whether an image still waits for something."""
        return {"images_waiting": float(self._receiver.next_deadline() is not None)}
