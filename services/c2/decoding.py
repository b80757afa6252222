"""Images that c2 has accepted in coded form and not stored yet: the backlog, and the threads that decode it."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import msgpack

from sonarpost import keys, wire
from sonarpost.archive import image_parts
from sonarpost.archive.decode_worker import Decoded, DecodeWorker
from sonarpost.delivery.store import Store
from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.logs import kv
from sonarpost.messages import CodedImage, ImagePart, ReconstructedImage
from sonarpost.runtime.service import ServiceStoppingError

log = logging.getLogger(__name__)

BACKLOG: Final = "undecoded/"
"""Prefix of the states with accepted images, in the order of their acceptance."""
BATCH_PER_WORKER: Final = 4
RETRY_S: Final = 1.0
MAX_WAITING: Final = 1000
"""Images of one vessel that wait for codebooks; further ones are quarantined."""


@dataclass(frozen=True, slots=True)
class AcceptedImage:
    """An entry of the backlog.

    Attributes:
        name: Name of its state.
        vessel_id: Vessel that sent it.
        payload: The record `part` of the whole image.
    """

    name: str
    vessel_id: str
    payload: bytes

    @classmethod
    def unpack(cls, name: str, value: bytes) -> AcceptedImage:
        """Parse the value of a state."""
        vessel_id, payload = msgpack.unpackb(value)
        return cls(name, vessel_id, payload)

    def pack(self) -> bytes:
        """Return the value of its state."""
        packed: bytes = msgpack.packb((self.vessel_id, self.payload))
        return packed

    def coded_image(self) -> CodedImage:
        """Return the coded image."""
        where = f"image of {self.vessel_id}"
        return image_parts.coded_image(wire.decode(ImagePart, self.payload, where), self.vessel_id, where)


class BacklogNames:
    """Names of new entries of the backlog, in ascending order also after a restart with an earlier clock."""

    def __init__(self, store: Store) -> None:
        names = store.state_names(BACKLOG)
        self._last = max((int(name.removeprefix(BACKLOG)) for name in names), default=0)

    def next(self) -> str:
        """Return a new name."""
        self._last = max(self._last + 1, time.time_ns())
        return f"{BACKLOG}{self._last:020d}"


@dataclass
class MissingCodebooks:
    """Codebooks that images of the backlog wait for.

    Attributes:
        vessels: Number of waiting images, by (model, vessel).
        lock: Protects the other attributes.
        on_added: Called after a codebook was found to be missing.
    """

    vessels: Counter[tuple[str, str]] = field(default_factory=Counter)
    lock: threading.Lock = field(default_factory=threading.Lock)
    on_added: Callable[[], None] = lambda: None

    def add(self, model: str, vessel: str) -> bool:
        """Count an image; return False if too many of its vessel wait already."""
        with self.lock:
            if sum(count for (_, name), count in self.vessels.items() if name == vessel) >= MAX_WAITING:
                return False
            is_new = (model, vessel) not in self.vessels
            self.vessels[model, vessel] += 1
        if is_new:
            self.on_added()
        return True

    def clear(self) -> None:
        """Forget all, before the backlog is tried again from its beginning."""
        with self.lock:
            self.vessels.clear()

    def pairs(self) -> list[tuple[str, str]]:
        """Return (model, vessel) of all that images wait for."""
        with self.lock:
            return sorted(self.vessels)

    def warning(self) -> str:
        """Return text for the health record; empty if no image waits."""
        with self.lock:
            waiting = sorted(self.vessels.items())
        return ", ".join(f"{count} images of {vessel} wait for codebook {model}" for (model, vessel), count in waiting)


class Decoding:
    """Decodes the backlog of a store, oldest first, with several processes.

    An image whose codebook is not known stays in the backlog until the codebook is there.

    Args:
        store: Store of c2.
        workers: The decoding processes.
        keep: Called with decoded images and their entries; writes the images to the disk and publishes them. Raises
            OSError or DeliveryError if that is not possible now; the images are decoded again.
        on_undecodable: Called with each image that was quarantined.
        stopping: Set when the service stops.
    """

    def __init__(
        self,
        store: Store,
        workers: Sequence[DecodeWorker],
        keep: Callable[[Sequence[ReconstructedImage], Sequence[AcceptedImage]], None],
        on_undecodable: Callable[[AcceptedImage, str], None],
        stopping: threading.Event,
    ) -> None:
        self._store = store
        self.workers = list(workers)
        self._idle = list(workers)
        self._idle_lock = threading.Lock()
        self._keep = keep
        self._on_undecodable = on_undecodable
        self._stopping = stopping
        self._changed = threading.Event()
        self._from_start = threading.Event()
        self.missing = MissingCodebooks()
        self.fault = ""

    def wake(self, *, codebook_added: bool = False) -> None:
        """Look for new entries; after a codebook was added, also at those that wait."""
        if codebook_added:
            self._from_start.set()
        self._changed.set()

    def close(self) -> None:
        """End the decoding processes."""
        self._changed.set()
        for worker in self.workers:
            worker.close()

    def run(self) -> None:
        """Decode until the service stops."""
        after = BACKLOG
        with ThreadPoolExecutor(len(self.workers), thread_name_prefix="decode") as pool:
            while not self._stopping.is_set():
                self._changed.clear()
                if self._from_start.is_set():
                    self._from_start.clear()
                    self.missing.clear()
                    after = BACKLOG
                try:
                    found = self._store.states_after(BACKLOG, after, BATCH_PER_WORKER * len(self.workers))
                    if found:
                        self._decode(pool, [AcceptedImage.unpack(name, value) for name, value in found])
                        after = found[-1][0]
                    self.fault = ""
                except ServiceStoppingError:
                    return
                except (OSError, DeliveryError) as error:
                    self.fault = f"images cannot be decoded and stored: {error}"
                    log.error("Images cannot be decoded and stored", extra=kv(reason=str(error)))
                    self._stopping.wait(RETRY_S)
                    continue
                if not found:
                    self._changed.wait()

    def _decode(self, pool: ThreadPoolExecutor, batch: Sequence[AcceptedImage]) -> None:
        results = list(pool.map(self._decode_one, batch))
        if self._stopping.is_set():
            return
        done, images = [], []
        for entry, result in zip(batch, results, strict=True):
            if result.image is not None:
                images.append(result.image)
            elif result.missing_model and self.missing.add(result.missing_model, entry.vessel_id):
                continue
            else:
                self._quarantine(entry, result.reason)
                continue
            done.append(entry)
        self._keep(images, done)
        with self._store.transaction() as tx:
            for entry in done:
                tx.delete_state(entry.name)

    def _decode_one(self, entry: AcceptedImage) -> Decoded:
        with self._idle_lock:
            worker = self._idle.pop()
        try:
            image = entry.coded_image()
            result = worker.decode(image)
            if result.is_crash and not self._stopping.is_set():
                # The process may have been killed for another reason than this image.
                log.error("Decoder crashed; trying the image once more", extra=kv(reason=result.reason))
                result = worker.decode(image)
        except BadInputError as error:
            return Decoded(reason=str(error))
        else:
            return result
        finally:
            with self._idle_lock:
                self._idle.append(worker)

    def _quarantine(self, entry: AcceptedImage, reason: str) -> None:
        with self._store.transaction() as tx:
            tx.quarantine("in", keys.shore_part(entry.vessel_id), entry.payload, reason)
            tx.delete_state(entry.name)
        self._on_undecodable(entry, reason)


def decode_workers(count: int, codebooks: Sequence[str], folder: Path, state_dir: Path) -> list[DecodeWorker]:
    """Return workers that are not started yet."""
    return [DecodeWorker(codebooks, folder, state_dir) for _ in range(count)]
