"""Polls a folder for files, finds what is worth sending in each, and hands it on."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Mapping
from pathlib import Path

import msgpack

from services.atd_stub import snippets
from services.atd_stub.config import AtdStubConfig
from services.atd_stub.folder import FileSeen, SettledFiles, content_hash, look_at, printable
from sonarpost import keys
from sonarpost.errors import HandoffError, SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.messages import Record, Snippet
from sonarpost.runtime.config import PlatformConfig
from sonarpost.runtime.logs import kv
from sonarpost.runtime.service import Effects, Service
from sonarpost.sonar.readers import SUPPORTED_SUFFIXES

log = logging.getLogger(__name__)

PICTURE_SUFFIXES = (".tif", ".tiff", ".png")


class AtdStubService(Service[AtdStubConfig]):
    """Processes every file once ever, known by its content.

    That a file was processed and the snippets found in it are committed together: a process killed while it works on
    a file begins that file again and owes its snippets once.
    """

    NAME = "atd_stub"

    def __init__(self, platform: PlatformConfig, config: AtdStubConfig) -> None:
        super().__init__(platform, config)
        self._suffixes = SUPPORTED_SUFFIXES if config.mode == "survey" else PICTURE_SUFFIXES
        self._settled = SettledFiles(config.settle_s)
        self._dealt_with: set[FileSeen] = set()
        self._waiting = -1

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Refuse: nothing is sent to this service."""
        raise NotImplementedError("atd_stub consumes no records")

    def on_start(self) -> None:
        """Start to poll."""
        self.spawn(self._poll, "poll")

    def gauges(self) -> Mapping[str, float]:
        """Return how many files wait; -1 before the first look."""
        return {"files_waiting": float(self._waiting)}

    def _poll(self) -> None:
        while not self.stopping.is_set():
            try:
                self._look()
            except (OSError, HandoffError) as error:
                self.problem(f"{type(error).__name__}: {error}")
            else:
                self.problem("")
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
        except (OSError, HandoffError):
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

    def _hand_on(self, path: Path, content: str, found: tuple[Snippet, ...], seconds: float) -> None:
        effects = Effects()
        for snippet in found:
            effects.send(keys.contact_detected(self.platform.id), "compressor", snippet)
        effects.put_state(_state_name(content), msgpack.packb({"file": printable(path.name), "contacts": len(found)}))
        effects.count("files_processed")
        effects.count("contacts_detected", len(found))
        self.commit(effects)
        log.info("File processed", extra=kv(file=path.name, contacts=len(found), seconds=seconds))
        for snippet in found:
            log.info(
                "Contact detected",
                extra=kv(
                    vehicle=self.platform.id,
                    contact_id=snippet.contact.contact_id,
                    file=path.name,
                    confidence=snippet.contact.atd_confidence,
                ),
            )

    def _snippets(self, path: Path, content: str) -> tuple[Snippet, ...]:
        if self.config.mode == "snippets":
            return snippets.from_picture(path, content, self.platform.id)
        return snippets.from_survey(path, content, self.platform.id, self.config)

    def _meet_again(self, path: Path, content: str, kept: bytes) -> None:
        """Leave a file that was processed; put one that was refused aside again, where it will be found."""
        reason = msgpack.unpackb(kept).get("refused")
        log.info("File known already", extra=kv(file=path.name, refused=reason or "no"))
        if reason is not None:
            self._move_aside(path, content, reason)

    def _quarantine(self, path: Path, content: str, reason: str) -> None:
        """Remember a bad file, so that it is looked at once, and move it aside with its reason."""
        reason = printable(reason)
        log.error("File quarantined", extra=kv(file=path.name, reason=reason))
        effects = Effects()
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
