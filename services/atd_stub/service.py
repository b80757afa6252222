"""The atd_stub service: polls a folder, detects contacts in its files, and releases the most confident first."""

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
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.file_boundary import FileEndStore
from sonarpost.services.atd_stub.input_folder import (
    InputFile,
    StableFiles,
    content_sha256,
    list_input_files,
    printable,
)
from sonarpost.services.atd_stub.release import ContactRelease
from sonarpost.services.atd_stub.snippet_files import read_snippet, write_snippet
from sonarpost.services.atd_stub.survey_detection import DetectionResult, detect_in_survey
from sonarpost.sonar.readers import SUPPORTED_SUFFIXES

log = logging.getLogger(__name__)

IMAGE_SUFFIXES = (".tif", ".tiff", ".png")


class AtdStubService(Service[AtdStubConfig]):
    """Processes each file once, identified by its content.

    The entry of a file and its snippets are committed together: a process that is killed during a file starts that
    file again and sends its snippets once. A snippet is in one place of the store at any time: held at the end of a
    file, waiting for release, or in the outbox.
    """

    NAME = "atd_stub"

    def __init__(self, platform: PlatformConfig, config: AtdStubConfig) -> None:
        super().__init__(platform, config)
        self._suffixes = SUPPORTED_SUFFIXES if config.mode == "survey" else IMAGE_SUFFIXES
        self._stable_files = StableFiles(config.settle_s, require_done_marker=config.require_done_marker)
        self._processed: set[InputFile] = set()
        self._files_waiting = -1
        self._release = ContactRelease(platform, self.store, config.max_in_flight, self.commit)
        self._file_ends = FileEndStore(self.store)

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Not called: this service consumes no records."""
        raise NotImplementedError("atd_stub consumes no records")

    def on_start(self) -> None:
        """Subscribe to the state of the transmit queue, and start to poll and to release."""
        self._release.subscribe(self.session)
        self.start_thread(self._poll, "poll")
        self.start_thread(lambda: self._release.run(self.stopping), "release")

    def on_stop(self) -> None:
        """Wake the release thread, so that it ends."""
        self._release.wake()

    def gauges(self) -> Mapping[str, float]:
        """Return the numbers of files (-1 before the first poll) and contacts that wait."""
        return {
            "files_waiting": float(self._files_waiting),
            "contacts_waiting": float(self._release.pending + self._file_ends.held_count),
            "contacts_in_flight": float(self._release.in_flight),
        }

    def degraded_reason(self) -> str:
        """Return why contacts cannot be released."""
        return self._release.error

    def warning(self) -> str:
        """Return how many contacts wait for release."""
        return self._release.status

    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Check for free credit after the compressor has accepted or refused a snippet."""
        self._release.wake()

    def _poll(self) -> None:
        while not self.stopping.is_set():
            try:
                self._release_expired_contacts()
                self._process_folder()
            except (OSError, DeliveryError) as error:
                self.set_degraded(f"{type(error).__name__}: {error}")
            else:
                self.set_degraded("")
            self.stopping.wait(self.config.poll_s)

    def _process_folder(self) -> None:
        self.config.input_dir.mkdir(parents=True, exist_ok=True)
        files = list_input_files(self.config.input_dir, self._suffixes)
        self._processed &= set(files)
        new = tuple(file for file in files if file not in self._processed)
        complete = self._stable_files.update(new, time.monotonic())
        self._files_waiting = len(new)
        first_error: OSError | None = None
        for file in complete:
            if self.stopping.is_set():
                return
            try:
                is_finished = self._process(file)
            except OSError as error:
                # The files after it are processed first; it is tried again with the next poll.
                first_error = first_error or error
                continue
            if is_finished:
                self._processed.add(file)
                self._files_waiting -= 1
        if first_error is not None:
            raise first_error

    def _process(self, file: InputFile) -> bool:
        """Process a file; return False if it was removed or changed and has to be tried again."""
        try:
            content = content_sha256(file.path)
        except FileNotFoundError:
            return False
        if (entry := self.store.get_state(_state_name(content))) is not None:
            self._skip_known(file.path, content, entry)
            return True
        return self._detect(file.path, content)

    def _detect(self, path: Path, content: str) -> bool:
        started = time.perf_counter()
        try:
            result = self._contacts_of(path, content)
        except SurveyFileError as error:
            # If the file was removed or changed during the search, the error is not about this content.
            if not _is_unchanged(path, content):
                return False
            self._quarantine(path, content, str(error))
            return True
        except (OSError, DeliveryError):
            raise
        except Exception as error:
            # A defect of the detector must not block the files after this one.
            log.exception("File not processed", extra=kv(file=path.name))
            self._quarantine(path, content, f"{type(error).__name__}: {error}")
            return True
        if not _is_unchanged(path, content):
            log.warning("File changed while it was read; trying again", extra=kv(file=path.name))
            return False
        self._commit_result(path, content, result, round(time.perf_counter() - started, 2))
        return True

    def _contacts_of(self, path: Path, content: str) -> DetectionResult:
        if self.config.mode == "snippets":
            return DetectionResult((read_snippet(path, content, self.platform.id),), contact_count=1)
        file_ends = self._file_ends.by_sonar()
        return detect_in_survey(path, content, self.platform.id, self.config, file_ends, time.time())

    def _commit_result(self, path: Path, content: str, result: DetectionResult, duration_s: float) -> None:
        effects = UnitOfWork()
        entry = {"file": printable(path.name), "contacts": result.contact_count}
        effects.put_state(_state_name(content), msgpack.packb(entry))
        effects.count("files_processed")
        effects.count("contacts_detected", result.contact_count)
        no_continuation = self._file_ends.put(effects, result.file_end, joined=result.joined)
        self._commit_contacts(effects, (*result.snippets, *no_continuation))
        log.info(
            "File processed",
            extra=kv(file=path.name, contacts=result.contact_count, joined=result.joined, duration_s=duration_s),
        )
        for warning in result.warnings:
            log.warning("Survey reader warning", extra=kv(file=path.name, warning=printable(warning)))

    def _commit_contacts(self, effects: UnitOfWork, snippets: tuple[Snippet, ...]) -> None:
        """Commit `effects` and contacts that are ready for release; their files are written before."""
        if self.config.snippet_dir is not None:
            for snippet in snippets:
                write_snippet(self.config.snippet_dir, snippet)
        self._release.add(effects, snippets)
        self._file_ends.committed()
        for snippet in snippets:
            log.info(
                "Contact detected",
                extra=kv(
                    vehicle=self.platform.id,
                    contact_id=snippet.contact.contact_id,
                    file=snippet.source,
                    confidence=snippet.contact.atd_confidence,
                ),
            )

    def _release_expired_contacts(self) -> None:
        effects = UnitOfWork()
        expired = self._file_ends.release_expired(effects, time.time(), self.config.join_timeout_s)
        if expired:
            log.info(
                "No continuation file within join_timeout_s; releasing held contacts", extra=kv(contacts=len(expired))
            )
            self._commit_contacts(effects, expired)

    def _skip_known(self, path: Path, content: str, entry: bytes) -> None:
        """Skip a file that was processed before; move one that was refused to the quarantine again."""
        known = msgpack.unpackb(entry)
        refused_reason = known.get("refused")
        log.info(
            "File already processed",
            extra=kv(file=path.name, processed_as=known.get("file"), refused=refused_reason or "no"),
        )
        if refused_reason is not None:
            self._move_to_quarantine(path, content, refused_reason)

    def _quarantine(self, path: Path, content: str, reason: str) -> None:
        """Store that a file is bad, so that it is read once only, and move it to the quarantine with the reason."""
        reason = printable(reason)
        log.error("File quarantined", extra=kv(file=path.name, reason=reason))
        effects = UnitOfWork()
        effects.put_state(_state_name(content), msgpack.packb({"file": printable(path.name), "refused": reason}))
        effects.count("files_quarantined")
        self.commit(effects)
        self._move_to_quarantine(path, content, reason)

    def _move_to_quarantine(self, path: Path, content: str, reason: str) -> None:
        folder = self.config.quarantine_dir or self.config.input_dir / "quarantine"
        target = folder / path.name
        if target.exists():
            # Another bad file of this name is there and must not be overwritten.
            target = folder / f"{path.stem}-{content[:8]}{path.suffix}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(target.with_name(f"{target.name}.reason.txt"), f"{reason}\n".encode())
            # Not a rename: the quarantine may be on another disk.
            shutil.move(path, target)
        except OSError as error:
            # In a read-only folder the file stays; its stored entry prevents that it is processed again.
            log.warning("File cannot be moved to quarantine", extra=kv(file=path.name, error=str(error)))


def _is_unchanged(path: Path, content: str) -> bool:
    """Return whether the file exists and has the content that was read.

    Raises:
        OSError: It cannot be read.
    """
    try:
        return content_sha256(path) == content
    except FileNotFoundError:
        return False


def _state_name(content: str) -> str:
    return f"file:{content}"
