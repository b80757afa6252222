"""Polls a folder for files, finds what is worth sending in each, and lets it go as the water takes it."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Mapping
from pathlib import Path

import msgpack

from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import DeliveryError, SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.logs import kv
from sonarpost.messages import Record, Snippet
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.atd_stub import snippets
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.folder import FileSeen, SettledFiles, content_hash, look_at, printable
from sonarpost.services.atd_stub.outgoing import Outgoing
from sonarpost.services.atd_stub.seam_store import SeamStore
from sonarpost.services.atd_stub.survey_walk import Finding
from sonarpost.services.atd_stub.text_file import write_snippet
from sonarpost.sonar.readers import SUPPORTED_SUFFIXES

log = logging.getLogger(__name__)

PICTURE_SUFFIXES = (".tif", ".tiff", ".png")


class AtdStubService(Service[AtdStubConfig]):
    """Processes every file once ever, known by its content, and sends the most confident contacts first.

    That a file was processed and the snippets found in it are committed together: a process killed while it works on
    a file begins that file again and owes its snippets once. A snippet is in one place of the store at any time: held
    at a seam, in the pool, or owed to the compressor.
    """

    NAME = "atd_stub"

    def __init__(self, platform: PlatformConfig, config: AtdStubConfig) -> None:
        super().__init__(platform, config)
        self._suffixes = SUPPORTED_SUFFIXES if config.mode == "survey" else PICTURE_SUFFIXES
        self._settled = SettledFiles(config.settle_s, require_done_marker=config.require_done_marker)
        self._dealt_with: set[FileSeen] = set()
        self._waiting = -1
        self._outgoing = Outgoing(platform, self.store, config.max_in_flight, self.commit)
        self._seams = SeamStore(self.store)

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Refuse: nothing is sent to this service."""
        raise NotImplementedError("atd_stub consumes no records")

    def on_start(self) -> None:
        """Watch what waits on the way to the water, and start to poll."""
        self._outgoing.listen(self.session)
        self.start_thread(self._poll, "poll")
        self.start_thread(lambda: self._outgoing.run(self.stopping), "release")

    def on_stop(self) -> None:
        """Let the threads look up."""
        self._outgoing.wake()

    def gauges(self) -> Mapping[str, float]:
        """Return how many files (-1 before the first look) and contacts wait."""
        return {
            "files_waiting": float(self._waiting),
            "contacts_waiting": float(self._outgoing.waiting + self._seams.held),
            "contacts_on_the_way": float(self._outgoing.on_the_way),
        }

    def degraded_reason(self) -> str:
        """Return what keeps contacts from being handed on."""
        return self._outgoing.trouble

    def warning(self) -> str:
        """Say that contacts wait for the water."""
        waiting = self._outgoing.waiting
        return f"{waiting} contacts wait for room on the way to the water" if waiting else ""

    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Count what the compressor has taken."""
        if reason is None:
            self._outgoing.taken()
        else:
            self._outgoing.wake()

    def _poll(self) -> None:
        while not self.stopping.is_set():
            try:
                self._end_seams()
                self._look()
            except (OSError, DeliveryError) as error:
                self.set_degraded(f"{type(error).__name__}: {error}")
            else:
                self.set_degraded("")
            self.stopping.wait(self.config.poll_s)

    def _look(self) -> None:
        self.config.input_dir.mkdir(parents=True, exist_ok=True)
        here = look_at(self.config.input_dir, self._suffixes)
        self._dealt_with &= set(here)
        fresh = tuple(seen for seen in here if seen not in self._dealt_with)
        ready = self._settled.look(fresh, time.monotonic())
        self._waiting = len(fresh)
        unreadable: OSError | None = None
        for seen in ready:
            if self.stopping.is_set():
                return
            try:
                finished = self._process(seen)
            except OSError as error:
                # Told when the files behind it have had their turn; it is tried again at the next look.
                unreadable = unreadable or error
                continue
            if finished:
                self._dealt_with.add(seen)
                self._waiting -= 1
        if unreadable is not None:
            raise unreadable

    def _process(self, seen: FileSeen) -> bool:
        """Deal with a file; False when it went away or changed meanwhile and is to be looked at again."""
        try:
            content = content_hash(seen.path)
        except FileNotFoundError:
            return False
        if (kept := self.store.get_state(_state_name(content))) is not None:
            self._meet_again(seen.path, content, kept)
            return True
        return self._detect(seen.path, content)

    def _detect(self, path: Path, content: str) -> bool:
        started = time.perf_counter()
        try:
            found = self._snippets(path, content)
        except SurveyFileError as error:
            # A file that went away or changed while it was read says nothing about the content that was meant.
            if not _is_still(path, content):
                return False
            self._quarantine(path, content, str(error))
            return True
        except (OSError, DeliveryError):
            raise
        except Exception as error:
            # A defect of ours must not stop the files behind this one.
            log.exception("File not processed", extra=kv(file=path.name))
            self._quarantine(path, content, f"{type(error).__name__}: {error}")
            return True
        if not _is_still(path, content):
            log.warning("File changed while it was read, looking again later", extra=kv(file=path.name))
            return False
        self._hand_on(path, content, found, round(time.perf_counter() - started, 2))
        return True

    def _hand_on(self, path: Path, content: str, found: Finding, seconds: float) -> None:
        effects = UnitOfWork()
        effects.put_state(
            _state_name(content), msgpack.packb({"file": printable(path.name), "contacts": found.contacts})
        )
        effects.count("files_processed")
        effects.count("contacts_detected", found.contacts)
        freed = self._seams.keep(effects, found.seam, joined=found.joined)
        self._commit_contacts(effects, (*found.snippets, *freed))
        log.info(
            "File processed",
            extra=kv(file=path.name, contacts=found.contacts, joined=found.joined, seconds=seconds),
        )
        for warning in found.warnings:
            log.warning("Met in the survey", extra=kv(file=path.name, what=printable(warning)))

    def _commit_contacts(self, effects: UnitOfWork, ready: tuple[Snippet, ...]) -> None:
        """Commit effects, and contacts that are ready to go, whose files are written before."""
        if self.config.snippet_dir is not None:
            for snippet in ready:
                write_snippet(self.config.snippet_dir, snippet)
        self._outgoing.add(effects, ready)
        self._seams.committed()
        for snippet in ready:
            log.info(
                "Contact detected",
                extra=kv(
                    vehicle=self.platform.id,
                    contact_id=snippet.contact.contact_id,
                    file=snippet.source,
                    confidence=snippet.contact.atd_confidence,
                ),
            )

    def _end_seams(self) -> None:
        """Let go what waited long enough for a file that has not come."""
        effects = UnitOfWork()
        freed = self._seams.end(effects, time.time(), self.config.join_timeout_s)
        if freed:
            log.info("No file goes on where the last one ended", extra=kv(contacts=len(freed)))
            self._commit_contacts(effects, freed)

    def _snippets(self, path: Path, content: str) -> Finding:
        if self.config.mode == "snippets":
            return snippets.from_picture(path, content, self.platform.id)
        seams = self._seams.all()
        return snippets.from_survey(path, content, self.platform.id, self.config, seams, time.time())

    def _meet_again(self, path: Path, content: str, kept: bytes) -> None:
        """Leave a file that was processed; put one that was refused aside again, where it will be found."""
        known = msgpack.unpackb(kept)
        reason = known.get("refused")
        log.info("File known already", extra=kv(file=path.name, processed_as=known.get("file"), refused=reason or "no"))
        if reason is not None:
            self._move_aside(path, content, reason)

    def _quarantine(self, path: Path, content: str, reason: str) -> None:
        """Remember a bad file, so that it is looked at once, and move it aside with its reason."""
        reason = printable(reason)
        log.error("File quarantined", extra=kv(file=path.name, reason=reason))
        effects = UnitOfWork()
        effects.put_state(_state_name(content), msgpack.packb({"file": printable(path.name), "refused": reason}))
        effects.count("files_quarantined")
        self.commit(effects)
        self._move_aside(path, content, reason)

    def _move_aside(self, path: Path, content: str, reason: str) -> None:
        folder = self.config.quarantine_dir or self.config.input_dir / "quarantine"
        target = folder / path.name
        if target.exists():
            # Another bad file of this name lies there, and stays.
            target = folder / f"{path.stem}-{content[:8]}{path.suffix}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(target.with_name(f"{target.name}.reason.txt"), f"{reason}\n".encode())
            # The quarantine may be on another disk, where a rename does not reach.
            shutil.move(path, target)
        except OSError as trouble:
            # A read-only folder: the file stays, and is known by its content.
            log.warning("File cannot be moved", extra=kv(file=path.name, error=str(trouble)))


def _is_still(path: Path, content: str) -> bool:
    """Return whether the file is there and its content is the one that was read; OSError when it cannot be told."""
    try:
        return content_hash(path) == content
    except FileNotFoundError:
        return False


def _state_name(content: str) -> str:
    return f"file:{content}"
