"""Which files of a polled folder are complete, decided from what two looks at it have seen."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

DONE_SUFFIX = ".done"


@dataclass(frozen=True, slots=True)
class FileSeen:
    """A file as one look at the folder found it; `is_done` when its recorder has put `NAME.done` beside it."""

    path: Path
    size_bytes: int
    modified_ns: int
    is_done: bool = field(default=False, compare=False)


class SettledFiles:
    """Tells which files have stopped growing.

    Args:
        settle_s: How long size and date must stay as they are; not at all where a file is done.
        require_done_marker: Nothing counts that is not done.
    """

    def __init__(self, settle_s: float, *, require_done_marker: bool = False) -> None:
        self._settle_s = settle_s
        self._needs_done = require_done_marker
        self._since: dict[FileSeen, float] = {}

    def look(self, files: tuple[FileSeen, ...], now: float) -> tuple[FileSeen, ...]:
        """Return the files that have settled, oldest first (then by name, for files of one date).

        Args:
            files: Everything in the folder now.
            now: Seconds on a clock that never goes back.
        """
        self._since = {seen: self._since.get(seen, now) for seen in files}
        is_done = {seen.path: seen.is_done for seen in files}
        settled = (
            seen
            for seen, since in self._since.items()
            if is_done[seen.path] or (now - since >= self._settle_s and not self._needs_done)
        )
        return tuple(sorted(settled, key=lambda seen: (seen.modified_ns, seen.path.name)))


def look_at(folder: Path, suffixes: tuple[str, ...]) -> tuple[FileSeen, ...]:
    """Return the regular files of these suffixes in `folder`, hidden ones (still being copied) left out.

    Raises:
        OSError: The folder cannot be read.
    """
    found = []
    listed = tuple(folder.iterdir())
    names = {path.name for path in listed}
    for path in listed:
        if path.name.startswith(".") or path.suffix.lower() not in suffixes:
            continue
        if not path.is_file():
            continue  # a folder, a pipe, a link that leads nowhere
        try:
            status = path.stat()
        except FileNotFoundError:
            continue  # taken away since the folder was listed
        found.append(FileSeen(path, status.st_size, status.st_mtime_ns, path.name + DONE_SUFFIX in names))
    return tuple(found)


def printable(text: str) -> str:
    """Return `text` with the bytes of a file name that are not UTF-8 written out, as records and logs need it."""
    return text.encode("utf-8", "backslashreplace").decode()


def content_hash(path: Path) -> str:
    """Return the hex sha256 of a file's content, by which it is known whatever its name.

    Raises:
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
