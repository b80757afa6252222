"""Images that c2 has accepted in coded form and not stored yet: the backlog, and the threads that decode it."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final

from sonarpost.archive.backlog import Backlog, BacklogRecord
from sonarpost.archive.decode_worker import Decoded, DecodeWorker, PackedImage
from sonarpost.delivery.store import Store
from sonarpost.errors import DeliveryError, can_concern_record
from sonarpost.limits import Turns, limit
from sonarpost.logs import kv
from sonarpost.runtime.service import ServiceStoppingError

log = logging.getLogger(__name__)

SURFACE: Final = "decoding of images"
BATCH_PER_WORKER: Final = limit(
    4, "images", "shares", SURFACE, "vessel", "images of a turn for each decoding process", "the next vessel follows"
)
BATCH_BYTES: Final = limit(
    8 * 1024 * 1024, "bytes", "claims", SURFACE, "vessel", "pixels stored together", "stored in parts"
)
RETRY_S: Final = 1.0
MAX_RETRY_S: Final = 16.0
PAUSE_FACTOR: Final = limit(
    4, "times its duration", "shares", SURFACE, "vessel", "pause after a decoder's crash", "other vessels are served"
)
MAX_PAUSE_S: Final = 300.0
FAILURES_ALONE: Final = limit(
    2, "failures", "blame", SURFACE, "vessel", "failures alone, others stored since", "the image is quarantined"
)
MAX_WAITING: Final = limit(
    1000, "images", "shares", SURFACE, "vessel", "images that wait for codebooks", "further ones are quarantined"
)
MAX_MODELS: Final = limit(
    8, "codebooks", "shares", "codebooks of vessels", "vessel", "codebooks to wait for", "others wait"
)


@dataclass
class MissingCodebooks:
    """Codebooks that images of the backlog wait for.

    Attributes:
        vessels: Number of waiting images, by vessel and model; the images of models above `MAX_MODELS` count as of "".
        lock: Protects the other attributes.
        on_added: Called after a codebook was found to be missing.
    """

    vessels: dict[str, Counter[str]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    on_added: Callable[[], None] = lambda: None

    def add(self, model: str, vessel: str) -> bool:
        """Count an image; return False if too many of its vessel wait already."""
        with self.lock:
            models = self.vessels.setdefault(vessel, Counter())
            if models.total() >= MAX_WAITING:
                return False
            if model not in models and len(models) >= MAX_MODELS:
                model = ""
            is_new = model not in models
            models[model] += 1
        if is_new and model:
            self.on_added()
        return True

    def clear(self, vessel: str) -> None:
        """Forget a vessel, before its images are tried again from the first one."""
        with self.lock:
            self.vessels.pop(vessel, None)

    def models(self) -> dict[str, list[str]]:
        """Return the models that images wait for, by vessel."""
        with self.lock:
            return {vessel: sorted(model for model in models if model) for vessel, models in self.vessels.items()}

    def warning(self) -> str:
        """Return text for the health record; empty if no image waits."""
        with self.lock:
            waiting = [
                (v, m, count) for v, models in sorted(self.vessels.items()) for m, count in sorted(models.items())
            ]
        return ", ".join(
            f"{count} images of {vessel} wait for {f'codebook {model}' if model else 'other codebooks'}"
            for vessel, model, count in waiting
        )


@dataclass(slots=True)
class _Failing:
    """An image that was not decoded or stored.

    Attributes:
        stored: Number of images that were stored before its last failure.
        alone: Failures that count against it, see `FAILURES_ALONE`.
    """

    stored: int
    alone: int = 0


@dataclass(slots=True)
class _Vessel:
    """Images of one vessel.

    Attributes:
        after: Number of the last entry that was tried.
        failing: Images that failed, by number; they are tried again, each alone.
        failures: Consecutive failures.
        retry_at_s: When its images are tried again, by the monotonic clock.
    """

    after: int = 0
    failing: dict[int, _Failing] = field(default_factory=dict)
    failures: int = 0
    retry_at_s: float = 0.0


class Decoding:
    """Decodes the backlog of c2 with several processes: the vessels in turn, the images of each oldest first.

    An image whose codebook is not known stays in the backlog until the codebook is there. After a failure that is not
    known to be one of the image, its vessel pauses and the image is tried again.

    Args:
        store: Store of c2, for the quarantine.
        backlog: Returns the backlog.
        workers: The decoding processes.
        keep: Called with decoded images and their entries; stores the images, removes the entries from the backlog, and
            publishes the images. Raises an exception if that is not possible now; the images are decoded again.
        on_undecodable: Called with each image that was quarantined; removes it from the backlog.
        stopping: Set when the service stops.

    Attributes:
        fault: Why images wait; empty if they do not.
    """

    def __init__(
        self,
        store: Store,
        backlog: Callable[[], Backlog],
        workers: Sequence[DecodeWorker],
        keep: Callable[[Sequence[PackedImage], Sequence[BacklogRecord]], None],
        on_undecodable: Callable[[BacklogRecord, str], None],
        stopping: threading.Event,
    ) -> None:
        self._store = store
        self._backlog = backlog
        self.workers = list(workers)
        self._idle = list(workers)  # its methods are atomic
        self._keep = keep
        self._on_undecodable = on_undecodable
        self._stopping = stopping
        self._changed = threading.Event()
        self._from_start: set[str] = set()
        self._vessels: dict[str, _Vessel] = {}
        self._turns, self._again_turns = Turns(), Turns()
        self._stored = 0
        self._reason = ""
        self.missing = MissingCodebooks()
        self.fault = ""

    def wake(self, codebook_of: str = "") -> None:
        """Look for new entries; after a codebook of a vessel was added, also at those of it that wait."""
        if codebook_of:
            self._from_start.add(codebook_of)
        self._changed.set()

    def close(self) -> None:
        """End the decoding processes."""
        self._changed.set()
        for worker in self.workers:
            worker.close()

    def run(self) -> None:
        """Decode until the service stops."""
        with ThreadPoolExecutor(len(self.workers), thread_name_prefix="decode") as pool:
            while not self._stopping.is_set():
                self._changed.clear()
                try:
                    found = self._round(pool)
                except ServiceStoppingError:
                    return
                except Exception as error:
                    if not isinstance(error, DeliveryError):
                        log.exception("Images not decoded after an unexpected exception; trying again")
                    self.fault = f"images cannot be decoded and stored: {error}"
                    log.error("Images cannot be decoded and stored", extra=kv(reason=str(error)))
                    self._from_start.update(self._vessels)  # the images of this round are tried again
                    self._stopping.wait(RETRY_S)
                    continue
                failing = sum(len(vessel.failing) for vessel in self._vessels.values())
                self.fault = f"{failing} images cannot be decoded and stored now: {self._reason}" if failing else ""
                if not found:
                    now_s = time.monotonic()
                    ends_s = [v.retry_at_s for v in self._vessels.values() if v.failing or v.retry_at_s > now_s]
                    self._changed.wait(max(0.0, min(ends_s) - now_s) if ends_s else None)

    def _round(self, pool: ThreadPoolExecutor) -> bool:
        """Decode the next images of all vessels, then one that failed before; return whether there were any."""
        while self._from_start:
            name = self._from_start.pop()
            self.missing.clear(name)
            self._vessels.pop(name, None)
        next_ = self._next()
        self._decode(pool, next_)
        again = [] if self._stopping.is_set() else self._again()
        self._decode(pool, again)
        return bool(next_ or again)

    def _next(self) -> list[BacklogRecord]:
        """Return the next entries, of all vessels in turn."""
        count = BATCH_PER_WORKER * len(self.workers)
        backlog = self._backlog()
        names = [name for name in backlog.waiting_vessels() if self._is_due(name)]
        share = -(-count // max(1, len(names)))
        waiting = {name: backlog.waiting(name, self._vessel(name).after, share) for name in names}
        picked = self._turns.pick({name: entries for name, entries in waiting.items() if entries}, count)
        for entry in picked:
            self._vessel(entry.vessel_id).after = entry.id
        return picked

    def _vessel(self, name: str) -> _Vessel:
        return self._vessels.setdefault(name, _Vessel())

    def _is_due(self, name: str) -> bool:
        return self._vessel(name).retry_at_s <= time.monotonic()

    def _again(self) -> list[BacklogRecord]:
        """Return the failed image that has waited longest, if its vessel does not pause."""
        due = {n: [(n, id_) for id_ in v.failing] for n, v in self._vessels.items() if v.failing and self._is_due(n)}
        found: list[BacklogRecord] = []
        for name, id_ in self._again_turns.pick(due, 1):
            entry = self._backlog().waiting_record(id_)
            if entry is None:
                self._vessel(name).failing.pop(id_)
            else:
                found.append(entry)
        return found

    def _decode(self, pool: ThreadPoolExecutor, batch: Sequence[BacklogRecord]) -> None:
        results = list(pool.map(self._decode_one, batch))
        if self._stopping.is_set():
            return
        is_alone = len(batch) == 1
        failed: dict[str, float] = {}
        decoded: list[tuple[BacklogRecord, PackedImage]] = []
        for entry, (result, taken_s) in zip(batch, results, strict=True):
            if result.image is not None:
                decoded.append((entry, result.image))
            elif result.failure:
                counts = is_alone and result.failure == "crash"
                self._failed(entry, result.reason, counts=counts)
                lost_s = taken_s if result.failure == "crash" else 0.0
                failed[entry.vessel_id] = max(lost_s, failed.get(entry.vessel_id, 0.0))
            elif result.missing_model and self.missing.add(result.missing_model, entry.vessel_id):
                self._vessel(entry.vessel_id).failing.pop(entry.id, None)
            else:
                self._quarantine(entry, result.reason)
        for group in _groups(decoded):
            failed = dict.fromkeys(self._keep_parts(group, is_alone=is_alone), 0.0) | failed
        for name, lost_s in failed.items():
            vessel = self._vessel(name)
            pause_s = min(RETRY_S * 2**vessel.failures, MAX_RETRY_S) + min(PAUSE_FACTOR * lost_s, MAX_PAUSE_S)
            vessel.failures = min(vessel.failures + 1, 10)
            vessel.retry_at_s = time.monotonic() + pause_s

    def _decode_one(self, entry: BacklogRecord) -> tuple[Decoded, float]:
        """Decode an image; return the result and the duration in seconds."""
        started_s = time.monotonic()
        worker = self._idle.pop()
        try:
            result = worker.decode(entry.vessel_id, entry.payload)
        except Exception as error:
            log.exception("Image not decoded after an unexpected exception")
            result = Decoded(reason=f"{type(error).__name__}: {error}", failure="crash")
        finally:
            self._idle.append(worker)
        return result, time.monotonic() - started_s

    def _keep_parts(self, group: Sequence[tuple[BacklogRecord, PackedImage]], *, is_alone: bool) -> set[str]:
        """Store images, after a failure in halves; return the vessels of those that cannot be stored."""
        entries = [entry for entry, _ in group]
        try:
            self._keep([image for _, image in group], entries)
        except ServiceStoppingError:
            raise
        except Exception as error:
            if len(group) > 1:
                half = len(group) // 2
                return self._keep_parts(group[:half], is_alone=is_alone) | self._keep_parts(
                    group[half:], is_alone=is_alone
                )
            if not isinstance(error, (OSError, DeliveryError)):
                log.exception("Image not stored after an unexpected exception")
            self._failed(entries[0], str(error) or type(error).__name__, counts=is_alone and can_concern_record(error))
            return {entries[0].vessel_id}
        self._stored += len(entries)
        for entry in entries:
            vessel = self._vessel(entry.vessel_id)
            vessel.failing.pop(entry.id, None)
            vessel.failures, vessel.retry_at_s = 0, 0.0
        return set()

    def _failed(self, entry: BacklogRecord, reason: str, *, counts: bool) -> None:
        """Try an image again later; quarantine it if it alone has failed and others were stored in between."""
        self._reason = reason
        vessel = self._vessel(entry.vessel_id)
        log.error("Image not decoded and stored; it is tried again", extra=kv(vessel=entry.vessel_id, reason=reason))
        before = vessel.failing.pop(entry.id, None)
        alone = before.alone if before else 0
        if before is not None and counts and before.stored != self._stored:
            alone += 1
        if alone >= FAILURES_ALONE:
            self._quarantine(entry, reason)
        else:
            vessel.failing[entry.id] = _Failing(self._stored, alone)  # the last one in turn

    def _quarantine(self, entry: BacklogRecord, reason: str) -> None:
        with self._store.transaction() as tx:
            tx.quarantine("in", entry.key, entry.payload, reason, is_accepted=True)
        self._on_undecodable(entry, reason)
        self._vessel(entry.vessel_id).failing.pop(entry.id, None)


def _groups(
    decoded: Sequence[tuple[BacklogRecord, PackedImage]],
) -> Iterator[list[tuple[BacklogRecord, PackedImage]]]:
    """Yield images in groups of at most `BATCH_BYTES` of pixels, at least one each."""
    group: list[tuple[BacklogRecord, PackedImage]] = []
    size_bytes = 0
    for each in decoded:
        size_bytes += len(each[1].record.pixels.data)
        if group and size_bytes > BATCH_BYTES:
            yield group
            group, size_bytes = [], len(each[1].record.pixels.data)
        group.append(each)
    if group:
        yield group
