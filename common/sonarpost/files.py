"""Writing files so that each is whole or absent, whatever happens."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path


def write_atomically(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write `data` beside `path`, bring it to the disk, and put it in place of `path`.

    Args:
        path: The file to create or replace; its folder must exist.
        data: Everything the file shall hold.
        mode: Its permissions, whatever the umask says.

    Raises:
        OSError: It cannot be written (a full disk, no right to write); `path` is as it was.
    """
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            # mkstemp makes files private to the user; most of ours are meant to be read like any other.
            os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


@dataclass(frozen=True, slots=True)
class _Staged:
    descriptor: int
    temporary: Path
    path: Path
    last: bool


class AtomicFiles:
    """Files that are brought to the disk together: many share the waiting for it, and each is whole or absent.

    `add` writes beside the files' places, `commit` puts all in their places. Not for use from several threads.
    """

    def __init__(self) -> None:
        self._staged: list[_Staged] = []
        self._texts: dict[Path, bytes] = {}

    def __len__(self) -> int:
        return len(self._staged)

    def text_of(self, path: Path) -> bytes | None:
        """Return what an uncommitted file added with `last` shall hold, None where there is none."""
        return self._texts.get(path)

    def add(self, path: Path, data: bytes, *, last: bool = False, mode: int = 0o644) -> None:
        """Write a file beside its place.

        Args:
            path: The file to create or replace; its folder must exist.
            data: Everything it shall hold.
            last: It says that others are whole: it is put in its place when those are in theirs, on the disk.
            mode: Its permissions, whatever the umask says.

        Raises:
            OSError: It cannot be written; the other files are as they were.
        """
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
        self._staged.append(_Staged(descriptor, Path(name), path, last))
        try:
            # mkstemp makes files private to the user; most of ours are meant to be read like any other.
            os.fchmod(descriptor, mode)
            with os.fdopen(descriptor, "wb", closefd=False) as file:
                file.write(data)
        except BaseException:
            self.drop_from(len(self._staged) - 1)
            raise
        if last:
            self._texts[path] = data

    def drop_from(self, first: int) -> None:
        """Take back what was added from the number `first` on."""
        dropped, self._staged = self._staged[first:], self._staged[:first]
        for staged in dropped:
            self._texts.pop(staged.path, None)
            os.close(staged.descriptor)
            staged.temporary.unlink(missing_ok=True)

    def commit(self) -> None:
        """Bring all to the disk and put all in their places; afterwards nothing is added any more.

        Raises:
            OSError: They cannot be written; each is whole or as it was, and those `last` only where all others are.
        """
        try:
            for staged in self._staged:
                # All are on their way to the disk before the first is waited for.
                os.posix_fadvise(staged.descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            for staged in self._staged:
                os.fsync(staged.descriptor)
            for last in (False, True):
                moved = [staged for staged in self._staged if staged.last == last]
                for staged in moved:
                    staged.temporary.replace(staged.path)
                for folder in sorted({staged.path.parent for staged in moved}):
                    sync_folder(folder)
        finally:
            self.drop_from(0)


def sync_folder(folder: Path) -> None:
    """Make a rename in a folder durable: it lives in the folder, not in the file."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
