"""The polled input folder: which recordings are there, and which of them are complete."""

from __future__ import annotations

import errno
import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from sonarpost.files import open_regular
from sonarpost.limits import limit

DONE_SUFFIX = ".done"
MAX_RECORDING_BYTES: Final = limit(
    32 << 30, "bytes", "claims", "input folder", "recording", "size of its files", "it is not read; degraded"
)


@dataclass(frozen=True, slots=True)
class InputFile:
    """A file, or a recording of several files, as one poll of the folder found it.

    Attributes:
        path: The file; of several ones that which names the recording.
        size_bytes: Size of all files.
        modified_ns: Latest modification time.
        others: Other files of the recording that exist.
        missing: Number of files that do not exist yet.
        is_done: Whether its recorder has put `NAME.done` beside it. Not part of the comparison.
    """

    path: Path
    size_bytes: int
    modified_ns: int
    others: tuple[Path, ...] = ()
    missing: int = 0
    is_done: bool = field(default=False, compare=False)

    @property
    def parts(self) -> tuple[Path, ...]:
        """All files that exist, `path` first."""
        return (self.path, *self.others)


@dataclass(frozen=True, slots=True)
class InputFolder:
    """What one poll of the folder found.

    Attributes:
        files: Recordings that can be read.
        unreadable: Why the others cannot be read, by the name of their file.
    """

    files: tuple[InputFile, ...]
    unreadable: Mapping[str, str]


class StableFiles:
    """Decides which files are complete.

    Args:
        settle_s: A recording is complete when all its files exist and their sizes and dates have not changed for this
            long, or at once with `NAME.done`.
        require_done_marker: A file without `NAME.done` is never complete.
    """

    def __init__(self, settle_s: float, *, require_done_marker: bool = False) -> None:
        self._settle_s = settle_s
        self._require_done_marker = require_done_marker
        self._unchanged_since_s: dict[InputFile, float] = {}

    def update(self, files: tuple[InputFile, ...], now_s: float) -> tuple[InputFile, ...]:
        """Return the complete files, oldest first; files of one date are sorted by name.

        Args:
            files: All files of the folder now.
            now_s: Monotonic time.
        """
        self._unchanged_since_s = {file: self._unchanged_since_s.get(file, now_s) for file in files}
        is_done = {file.path: file.is_done for file in files}
        complete = (
            file
            for file, since_s in self._unchanged_since_s.items()
            if is_done[file.path]
            or (now_s - since_s >= self._settle_s and not file.missing and not self._require_done_marker)
        )
        return tuple(sorted(complete, key=lambda file: (file.modified_ns, file.path.name)))


def list_input_files(
    folder: Path, suffixes: tuple[str, ...], parts_of: Callable[[Path], tuple[Path, ...]] | None = None
) -> InputFolder:
    """Find the regular files with these suffixes. Names that begin with a dot are skipped (copy in progress).

    Args:
        folder: The folder.
        suffixes: Suffixes in lower case.
        parts_of: Names the files of a recording; None if each is one file.

    Raises:
        OSError: The folder cannot be read.
    """
    # scandir reports the kind of a file without a system call for it: one call for each file remains.
    with os.scandir(folder) as found:
        entries = tuple(found)
    names = {entry.name for entry in entries}
    files = []
    unreadable: dict[str, str] = {}
    for entry in entries:
        if entry.name.startswith(".") or not entry.name.lower().endswith(suffixes):
            continue
        try:
            if not entry.is_file():
                continue  # a folder, a pipe or a broken link
            status = entry.stat()
        except OSError as error:
            if error.errno not in (errno.ENOENT, errno.ELOOP):  # removed after the listing, or a link to itself
                unreadable[entry.name] = str(error)
            continue
        is_done = entry.name + DONE_SUFFIX in names
        file = InputFile(Path(entry.path), status.st_size, status.st_mtime_ns, is_done=is_done)
        try:
            file = file if parts_of is None else _with_parts(file, parts_of(file.path))
        except Exception as error:  # noqa: BLE001  a reader of another package may raise anything
            unreadable[entry.name] = f"{type(error).__name__}: {error}"
            continue
        if file.size_bytes > MAX_RECORDING_BYTES:
            unreadable[entry.name] = f"{file.size_bytes} bytes, expected at most {MAX_RECORDING_BYTES}"
        else:
            files.append(file)
    return InputFolder(tuple(files), unreadable)


def _with_parts(file: InputFile, parts: tuple[Path, ...]) -> InputFile:
    """Return the file with the other files of its recording.

    Raises:
        OSError: A file cannot be examined.
    """
    others: list[Path] = []
    size_bytes, modified_ns, missing = file.size_bytes, file.modified_ns, 0
    for part in parts:
        if part == file.path:
            continue
        try:
            status = part.stat()
        except (FileNotFoundError, NotADirectoryError):
            missing += 1
            continue
        others.append(part)
        size_bytes, modified_ns = size_bytes + status.st_size, max(modified_ns, status.st_mtime_ns)
    return replace(file, size_bytes=size_bytes, modified_ns=modified_ns, others=tuple(others), missing=missing)


def printable(text: str) -> str:
    """Return `text` with undecodable bytes of a file name escaped, as records and logs require."""
    return text.encode("utf-8", "backslashreplace").decode()


def content_sha256(path: Path) -> str:
    """Return the hex SHA-256 of a file's content, its identity under any name.

    Raises:
        OSError: The file cannot be read.
    """
    with os.fdopen(open_regular(path), "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
