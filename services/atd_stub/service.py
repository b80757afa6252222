"""The atd_stub service: polls a folder, detects contacts in its files, and releases the most confident first."""

from __future__ import annotations

import hashlib
import logging
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgpack
from typing_extensions import override

from sonarpost import keys
from sonarpost.archive.retention import DAY_S, Stored, remove_files, select_for_removal
from sonarpost.config import PlatformConfig
from sonarpost.delivery.records import OutboxItem
from sonarpost.delivery.transaction import Transaction
from sonarpost.detection.detector import classifier_of, counts_text
from sonarpost.detection.picks import picks_path
from sonarpost.detection.transmissions import WARNING_SHARE
from sonarpost.errors import BadInputError, DeliveryError, SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.logs import kv
from sonarpost.messages import Record, Snippet, VehicleStatus
from sonarpost.runtime.retention import INTERVAL_S, SteadyTime
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.file_boundary import FileEndStore
from sonarpost.services.atd_stub.input_folder import (
    DONE_SUFFIX,
    InputFile,
    StableFiles,
    content_sha256,
    list_input_files,
    printable,
)
from sonarpost.services.atd_stub.picks import STATE_PREFIX as _PICKS
from sonarpost.services.atd_stub.picks import PicksResult, contacts_of_picks, handled_lines, list_picks_files
from sonarpost.services.atd_stub.release import ContactRelease
from sonarpost.services.atd_stub.seabed_history import SeabedHistory
from sonarpost.services.atd_stub.snippet_files import SNIPPET_SUFFIXES, read_snippet, write_snippet
from sonarpost.services.atd_stub.survey_detection import DetectionResult, detect_in_survey
from sonarpost.services.atd_stub.transmissions import TransmissionLog
from sonarpost.sonar.image_files import IMAGE_SUFFIXES
from sonarpost.sonar.readers import recording_parts, supported_suffixes

log = logging.getLogger(__name__)

_FILE = "file:"
_Identities = tuple[tuple[int, ...], ...]
MAX_REASONS = 5
"""Number of faults in the health record."""


class AtdStubService(Service[AtdStubConfig]):
    """Processes each file once, identified by its content.

    The entry of a file and its snippets are committed together: a process that is killed during a file starts that
    file again and sends its snippets once. A snippet is in one place of the store at any time: held at the end of a
    file, waiting for release, or in the outbox.
    """

    NAME = "atd_stub"

    def __init__(self, platform: PlatformConfig, config: AtdStubConfig) -> None:
        super().__init__(platform, config)
        self._suffixes = supported_suffixes() if config.mode == "survey" else IMAGE_SUFFIXES
        self._stable_files = StableFiles(config.settle_s, require_done_marker=config.require_done_marker)
        self._present: tuple[InputFile, ...] = ()
        self._processed: dict[InputFile, str] = {}  # with the digest of the content
        self._incomplete: set[Path] = set()
        self._stable_picks = StableFiles(config.settle_s)
        self._handled_picks: set[InputFile] = set()
        self._retention_due_s = 0.0
        self._steady_time = SteadyTime()
        self._files_waiting = -1
        self._unreadable: dict[str, str] = {}
        self._release = ContactRelease(platform, self.store, config.max_in_flight, self.commit)
        self._file_ends = FileEndStore(self.store)
        self._malformed_transmissions = self.interval_log(log, logging.WARNING, "Ignoring malformed transmissions")
        self._transmissions = TransmissionLog(
            self.store, self.commit, self._ignore_transmissions, config.transmissions_file
        )
        self._seabed = SeabedHistory()
        self._status: VehicleStatus | None = None
        self._position_warning = ""

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Not called: this service consumes no records."""
        raise NotImplementedError("atd_stub consumes no records")

    @override
    def on_start(self) -> None:
        """Check the classifier, subscribe to transmit queue and transmissions, and start to poll and to release.

        Raises:
            ConfigError: The file of the classifier cannot be read, or has another identity than configured.
        """
        if self.config.mode == "survey":
            classifier_of(self.config.detector_settings())
        self._release.subscribe(self.session)
        if self._masks:
            self._transmissions.subscribe(self.session, self.platform.id)
        self.start_thread(self._poll, "poll")
        self.start_thread(lambda: self._release.run(self.stopping), "release")

    @override
    def on_stop(self) -> None:
        """Wake the release thread, so that it ends, and store the transmissions."""
        self._release.wake()
        if self._masks:
            self._transmissions.save_at_stop()

    def _ignore_transmissions(self, error: BadInputError) -> None:
        self.count("transmissions_ignored")
        self._malformed_transmissions.log(reason=str(error))

    @property
    def _masks(self) -> bool:
        return self.config.mask_transmissions and self.config.mode == "survey"

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return how many files (-1 before the first poll) and contacts wait, and the difficulty of the seabed."""
        return {
            "files_waiting": float(self._files_waiting),
            "files_unreadable": float(len(self._unreadable)),
            "contacts_waiting": float(self._release.pending + self._file_ends.held_count),
            "contacts_held": float(self._file_ends.held_count),
            "contacts_in_flight": float(self._release.in_flight),
            "transmissions_known": float(len(self._transmissions)),
            **self._seabed.gauges(time.monotonic()),
        }

    @override
    def degraded_reason(self) -> str:
        """Return why contacts cannot be released."""
        return self._release.error

    @override
    def warning(self) -> str:
        """Return what waits for release or a continuation file, whether Pd is low, and why positions may be wrong."""
        waiting = ""
        if held := self._file_ends.held_count:
            until = datetime.fromtimestamp(self._file_ends.held_until_utc_s, UTC).strftime("%H:%M:%S")
            waiting = f"{held} contacts held for a continuation file until {until} UTC"
        parts = (self._release.status, waiting, self._seabed.warning(), self._position_warning)
        return "; ".join(filter(None, parts))

    @override
    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> None:
        """Check for free credit after the compressor has accepted or refused a snippet."""
        self._release.wake()

    def _poll(self) -> None:
        steps = (
            self._release_expired_contacts,
            self._process_folder,
            self._save_transmissions,
            self._process_picks,
            self._publish_status,
            self._apply_retention,
        )
        while not self.stopping.is_set():
            reasons = []
            for step in steps:
                try:
                    step()
                except (OSError, DeliveryError) as error:
                    reasons.append(f"{type(error).__name__}: {error}")
            reasons += [f"{printable(name)}: {reason}" for name, reason in sorted(self._unreadable.items())]
            self.set_degraded("; ".join(reasons[:MAX_REASONS]))
            self.stopping.wait(self.config.poll_s)

    def _save_transmissions(self) -> None:
        if self._masks:
            self._transmissions.save(time.monotonic())

    def _publish_status(self) -> None:
        """Publish the status repeatedly, so that a uuv_modem that starts later receives it."""
        if self._status is not None:
            self.publish(keys.vehicle_status(self.platform.id), self._status)

    def _apply_retention(self) -> None:
        """Remove processed input files and stored snippets by age and total size, and the entries of old files.

        Raises:
            OSError: A file cannot be deleted.
            DeliveryError: The store cannot be read or written.
        """
        if time.monotonic() < self._retention_due_s:
            return
        self._retention_due_s, now_utc_s = time.monotonic() + INTERVAL_S, self._steady_time.now_utc_s()
        config = self.config
        entries = self.store.read_states(_FILE, lambda _, packed: _entry(packed))
        effects = UnitOfWork()
        stored = [
            Stored(file, max(entries[content]["processed_utc_s"], file.modified_ns * 1e-9), file.size_bytes)
            for file, content in self._processed.items()
            if content in entries and "refused" not in entries[content]
        ]
        chosen = select_for_removal(stored, now_utc_s, config.retain_days, config.max_bytes)
        removed = {file for file in chosen if self._remove(file)}
        present = {content for file, content in self._processed.items() if file not in removed}
        for name, entry in entries.items():
            if name not in present and now_utc_s - entry["processed_utc_s"] > config.retain_days * DAY_S:
                effects.delete_state(_FILE + name)
                effects.delete_state(_PICKS + name)
        if removed:
            effects.count("files_removed", len(removed))
        if config.snippet_dir is not None:
            snippets = remove_files(
                config.snippet_dir, SNIPPET_SUFFIXES, now_utc_s, config.retain_days, config.max_bytes
            )
            if snippets:
                effects.count("snippets_removed", len(snippets))
        self.commit(effects)

    def _remove(self, file: InputFile) -> bool:
        """Delete a recording and what belongs to it; return whether that was possible."""
        done = file.path.with_name(file.path.name + DONE_SUFFIX)
        try:
            for path in (*self._own_parts(file), file.path.with_suffix(".txt"), done, picks_path(file.path)):
                path.unlink(missing_ok=True)
            _remove_empty_folders(file)
        except OSError as error:
            log.warning("Input file cannot be removed", extra=kv(file=printable(file.path.name), error=str(error)))
            return False
        log.warning("Input file removed by retention", extra=kv(file=printable(file.path.name)))
        return True

    def _process_folder(self) -> None:
        self.config.input_dir.mkdir(parents=True, exist_ok=True)
        self._unreadable = {}
        found = list_input_files(
            self.config.input_dir, self._suffixes, _known_parts if self.config.mode == "survey" else None
        )
        files, self._unreadable = found.files, dict(found.unreadable)
        self._present, present = files, set(files)
        self._log_incomplete(files)
        self._processed = {file: content for file, content in self._processed.items() if file in present}
        new = tuple(file for file in files if file not in self._processed)
        complete = self._stable_files.update(new, time.monotonic())
        self._files_waiting = len(new)
        self._process_each(complete, self._process)

    def _process_each(self, files: Iterable[InputFile], process: Callable[[InputFile], None]) -> None:
        """Process files until the service stops. One that cannot be read is tried again with the next poll."""
        for file in files:
            if self.stopping.is_set():
                return
            try:
                process(file)
            except OSError as error:
                self._unreadable[file.path.name] = f"{type(error).__name__}: {error}"

    def _log_incomplete(self, files: tuple[InputFile, ...]) -> None:
        """Log each recording with missing files once."""
        incomplete = {file.path: file.missing for file in files if file.missing}
        for path in incomplete.keys() - self._incomplete:
            log.info("Recording waits for missing files", extra=kv(file=path.name, missing=incomplete[path]))
        self._incomplete = set(incomplete)

    def _process_picks(self) -> None:
        """Send the contacts of picks of processed surveys; each pick once.

        Raises:
            OSError: A file or the folder cannot be read.
            DeliveryError: The store cannot be read or written.
        """
        if self.config.mode != "survey":
            return
        surveys, unreadable = list_picks_files(self.config.input_dir, self._processed)
        self._unreadable |= unreadable
        self._handled_picks &= surveys.keys()
        new = tuple(file for file in surveys if file not in self._handled_picks)

        def process(file: InputFile) -> None:
            content = self._processed[surveys[file]]
            if (result := self._measured_picks(file, surveys[file], content)) is not None:
                self._commit_picks(file, content, result)
            self._handled_picks.add(file)

        self._process_each(self._stable_picks.update(new, time.monotonic()), process)

    def _measured_picks(self, file: InputFile, survey: InputFile, content: str) -> PicksResult | None:
        """Return the contacts of a file of picks; None if it was removed, or the survey cannot be read."""
        before = self.store.read_state(_PICKS + content, handled_lines, ())
        try:
            return contacts_of_picks(survey.path, content, file.path, before, self.platform.id, self.config)
        except FileNotFoundError:
            return None
        except SurveyFileError as error:
            log.error("Picks not processed", extra=kv(file=file.path.name, reason=printable(str(error))))
        except (OSError, DeliveryError):
            raise
        except Exception:
            # A defect of the measurement must not stop the polling.
            log.exception("Picks not processed", extra=kv(file=file.path.name))
        return None

    def _commit_picks(self, file: InputFile, content: str, result: PicksResult) -> None:
        """Commit the contacts of picks; their files are written before."""
        effects = UnitOfWork()
        effects.put_state(_PICKS + content, result.pack(time.time()))
        if result.errors:
            effects.count("picks_ignored", len(result.errors))
        if result.snippets:
            effects.count("contacts_picked", len(result.snippets))
        self._write_snippets(result.snippets)
        self._release.add(effects, result.snippets, are_picks=True)
        for reason in result.errors:
            log.warning("Pick ignored", extra=kv(file=file.path.name, reason=printable(reason)))
        for snippet in result.snippets:
            log.info("Contact picked", extra=kv(contact_id=snippet.contact.contact_id, file=snippet.source))

    def _process(self, file: InputFile) -> None:
        """Process a file; one that is removed or changed during this is tried again with the next poll."""
        try:
            before, content = _identities(file), _content_of(file)
        except FileNotFoundError:
            return
        if (entry := self.store.read_state(_FILE + content, _entry, None)) is not None:
            self._skip_known(file, content, entry)
        elif not self._detect(file, content, before):
            return
        self._processed[file] = content
        self._files_waiting -= 1

    def _detect(self, file: InputFile, content: str, before: _Identities) -> bool:
        """Detect the contacts of a file; return False if it was removed or changed."""
        path = file.path
        started = time.perf_counter()
        try:
            result = self._contacts_of(path, content)
        except SurveyFileError as error:
            # If the file was removed or changed during the search, the error is not about this content.
            if not _is_unchanged(file, before):
                return False
            self._quarantine(file, content, str(error))
            return True
        except (OSError, DeliveryError):
            raise
        except Exception as error:
            # A defect of the detector must not block the files after this one.
            log.exception("File not processed", extra=kv(file=path.name))
            self._quarantine(file, content, f"{type(error).__name__}: {error}")
            return True
        if not _is_unchanged(file, before):
            log.warning("File changed while it was read; trying again", extra=kv(file=path.name))
            return False
        self._commit_result(path, content, result, round(time.perf_counter() - started, 2))
        return True

    def _contacts_of(self, path: Path, content: str) -> DetectionResult:
        if self.config.mode == "snippets":
            file = read_snippet(path, content, self.platform.id, self.config.fit)
            return DetectionResult((file.snippet,), contact_count=1, warnings=file.notes)
        config, transmissions = self.config, None
        if self._masks:
            transmissions = self._transmissions.intervals(config.mask_before_s, config.mask_after_s)
        return detect_in_survey(path, content, self.platform.id, config, self._file_ends.by_sonar(), transmissions)

    def _commit_result(self, path: Path, content: str, result: DetectionResult, duration_s: float) -> None:
        effects = UnitOfWork()
        entry = {"file": printable(path.name), "contacts": result.contact_count, "processed_utc_s": time.time()}
        effects.put_state(_FILE + content, msgpack.packb(entry))
        effects.count("files_processed")
        if result.masked_pings:
            effects.count("pings_masked", result.masked_pings)
        if result.ends is not None:
            self._file_ends.put(effects, result.ends, time.time() + self.config.join_timeout_s)
        self._commit_contacts(effects, (*result.snippets, *result.not_continued))
        counts = {}
        if self.config.mode == "survey":
            threshold = self.config.confidence_threshold
            counts["counts"] = counts_text(threshold, result.contact_count, result.weaker)
            self._seabed.add(result.difficulty, time.monotonic())
            if self._is_newer(result.status):
                self._status = result.status
            note = result.position_note
            self._position_warning = f"{printable(path.name)}: {note}" if note else ""
            if result.difficulty is not None:
                counts["expected_pd"] = f"{result.difficulty.expected_pd:.2f}"
        log.info(
            "File processed",
            extra=kv(
                file=path.name,
                contacts=result.contact_count,
                joined=result.joined,
                masked_pings=result.masked_pings,
                duration_s=duration_s,
                **counts,
            ),
        )
        name = printable(path.name)
        _log_contacts("Held contact released", result.replaced, f"seen whole in {name}")
        _log_contacts("Held contact dropped", result.dropped, f"not detected in the pings joined with {name}")
        _log_contacts("Held contact released", result.not_continued, f"not continued by {name}")
        for snippet in result.held:
            log.info(
                "Contact held for continuation file",
                extra=kv(contact_id=snippet.contact.contact_id, file=snippet.source, wait_s=self.config.join_timeout_s),
            )
        if result.masked_share > WARNING_SHARE:
            log.warning(
                "Most pings masked: the modem transmitted during the recording",
                extra=kv(file=path.name, share=round(result.masked_share, 2), pings=result.masked_pings),
            )
        message = "Survey reader warning" if self.config.mode == "survey" else "Image file warning"
        for warning in result.warnings:
            log.warning(message, extra=kv(file=path.name, warning=printable(warning)))

    def _is_newer(self, status: VehicleStatus | None) -> bool:
        """Return whether a status is not older than the one that is published."""
        return status is not None and (self._status is None or status.time_utc_s >= self._status.time_utc_s)

    def _commit_contacts(self, effects: UnitOfWork, snippets: tuple[Snippet, ...]) -> None:
        """Count and commit contacts that are ready for release, with `effects`; their files are written before."""
        effects.count("contacts_detected", len(snippets))
        self._write_snippets(snippets)
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

    def _write_snippets(self, snippets: tuple[Snippet, ...]) -> None:
        if self.config.snippet_dir is not None:
            for snippet in snippets:
                write_snippet(self.config.snippet_dir, snippet)

    def _release_expired_contacts(self) -> None:
        effects = UnitOfWork()
        expired = self._file_ends.release_expired(effects, time.time(), self.config.join_timeout_s)
        if expired:
            self._commit_contacts(effects, expired)
            reason = f"no continuation file within {self.config.join_timeout_s:g} s"
            _log_contacts("Held contact released", expired, reason)

    def _skip_known(self, file: InputFile, content: str, entry: Mapping[str, Any]) -> None:
        """Skip a file that was processed before; move one that was refused to the quarantine again."""
        refused_reason = entry.get("refused")
        log.info(
            "File already processed",
            extra=kv(file=file.path.name, processed_as=entry.get("file"), refused=refused_reason or "no"),
        )
        if refused_reason is not None:
            self._move_to_quarantine(file, content, refused_reason)

    def _quarantine(self, file: InputFile, content: str, reason: str) -> None:
        """Store that a file is bad, so that it is read once only, and move it to the quarantine with the reason."""
        reason = printable(reason)
        log.error("File quarantined", extra=kv(file=file.path.name, reason=reason))
        effects = UnitOfWork()
        entry = {"file": printable(file.path.name), "refused": reason, "processed_utc_s": time.time()}
        effects.put_state(_FILE + content, msgpack.packb(entry))
        effects.count("files_quarantined")
        self.commit(effects)
        self._move_to_quarantine(file, content, reason)

    def _move_to_quarantine(self, file: InputFile, content: str, reason: str) -> None:
        path, parts = file.path, self._own_parts(file)
        folder = self.config.quarantine_dir or self.config.input_dir / "quarantine"
        names = [str(part.relative_to(path.parent)) for part in parts]
        if any((folder / name).exists() for name in names):
            # Another bad file of this name is there and must not be overwritten.
            unique = f"{path.stem}-{content[:8]}"
            if len(parts) > 1:
                folder /= unique  # files of one recording refer to each other by name
            else:
                names = [unique + path.suffix]
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(folder / f"{names[0]}.reason.txt", f"{reason}\n".encode())
            for part, name in reversed(list(zip(parts, names, strict=True))):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                # Not a rename: the quarantine may be on another disk.
                shutil.move(part, folder / name)
            _remove_empty_folders(file)
        except OSError as error:
            # In a read-only folder the file stays; its stored entry prevents that it is processed again.
            log.warning("File cannot be moved to quarantine", extra=kv(file=path.name, error=str(error)))

    def _own_parts(self, file: InputFile) -> tuple[Path, ...]:
        """Return the files of a recording in the input folder that no other recording there uses, its own first."""
        used = {part for other in self._present if other.path != file.path for part in other.parts}
        inside = (part for part in file.others if part.is_relative_to(file.path.parent) and part not in used)
        return (file.path, *inside)


def _log_contacts(event: str, snippets: tuple[Snippet, ...], reason: str) -> None:
    for snippet in snippets:
        log.info(event, extra=kv(contact_id=snippet.contact.contact_id, reason=reason))


def _known_parts(path: Path) -> tuple[Path, ...]:
    """Return the files of a recording; the file alone if its reader cannot be loaded, which reading it will report."""
    try:
        return recording_parts(path)
    except SurveyFileError:
        return (path,)


def _content_of(file: InputFile) -> str:
    """Return the hex SHA-256 of a file; of several files that of their digests in order.

    Raises:
        OSError: A file cannot be read.
    """
    digests = [content_sha256(part) for part in file.parts]
    return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()


def _entry(packed: bytes) -> dict[str, Any]:
    """Return the stored entry of a processed file."""
    entry = dict(msgpack.unpackb(packed))
    return entry | {"processed_utc_s": float(entry["processed_utc_s"])}


def _remove_empty_folders(file: InputFile) -> None:
    """Remove the empty folders of a recording below its own folder."""
    for folder in {part.parent for part in file.others} - {file.path.parent}:
        if folder.is_relative_to(file.path.parent) and not any(folder.iterdir()):
            folder.rmdir()


def _identities(file: InputFile) -> _Identities:
    """Return what changes if a file is replaced or written.

    Raises:
        OSError: A file cannot be examined.
    """
    found = (part.stat() for part in file.parts)
    return tuple((of.st_dev, of.st_ino, of.st_size, of.st_mtime_ns, of.st_ctime_ns) for of in found)


def _is_unchanged(file: InputFile, before: _Identities) -> bool:
    """Return whether the files exist and have not been replaced or written.

    Raises:
        OSError: One cannot be examined.
    """
    try:
        return _identities(file) == before
    except FileNotFoundError:
        return False
