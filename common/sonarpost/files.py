"""Atomic and durable writes: after a crash or power cut each file is complete or absent. Reading of regular files only.

Files get the permissions that the umask of the process allows, unless a mode is given. Services run with umask 077.
"""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

PRIVATE_FILE = 0o600
PUBLIC_FILE = 0o644
PRIVATE_FOLDER = 0o700
PRIVATE_UMASK = 0o077


def write_atomically(path: Path, data: bytes, mode: int | None = None) -> None:
    """Write a file with `atomic_file`.

    Raises:
        OSError: It cannot be written (full disk, no permission); `path` is unchanged.
    """
    with atomic_file(path, mode) as file:
        file.write(data)


@contextmanager
def atomic_file(path: Path, mode: int | None = None) -> Iterator[BinaryIO]:
    """Yield a temporary file; at the end of the block, flush it to the disk and rename it to `path`.

    Args:
        path: The file to create or replace; its folder must exist. It is unchanged if the block raises.
        mode: Its permissions, independent of the umask; None for those that the umask allows.

    Raises:
        OSError: It cannot be written (full disk, no permission); `path` is unchanged.
    """
    descriptor, temporary = _create_temporary(path, 0o666 if mode is None else PRIVATE_FILE)
    try:
        with os.fdopen(descriptor, "wb") as file:
            yield file
            file.flush()
            if mode is not None:
                os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def _create_temporary(path: Path, mode: int) -> tuple[int, Path]:
    """Create a temporary file for `path` with a mode that the umask limits; return its descriptor and path."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(8)}.tmp")
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        return os.open(temporary, flags, mode), temporary
    except OSError as error:
        error.filename = str(path)  # the file that the caller knows
        raise


def open_regular(path: Path) -> int:
    """Open a file for reading; return its descriptor. A pipe, a device and a socket are errors and do not block.

    Raises:
        OSError: It cannot be opened, or is not a regular file.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except ValueError as error:  # a zero byte in the name
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return descriptor


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file.

    Raises:
        OSError: It cannot be read, is not a regular file, is larger than `max_bytes`, or grows.
    """
    with os.fdopen(open_regular(path), "rb") as file:
        size_bytes = os.fstat(file.fileno()).st_size
        if size_bytes > max_bytes:
            raise OSError(errno.EFBIG, f"larger than {max_bytes} bytes", str(path))
        content = file.read(size_bytes + 1)
    if len(content) > size_bytes:
        raise OSError(errno.EAGAIN, "grows while it is read", str(path))
    return content


def make_private(path: Path) -> None:
    """Create a file that only its owner can read and write, or restrict an existing one to its owner.

    Raises:
        OSError: It cannot be created, or belongs to another user.
    """
    path.touch(PRIVATE_FILE)
    if path.is_file() and path.stat().st_mode & 0o077:
        path.chmod(PRIVATE_FILE)


@dataclass(frozen=True, slots=True)
class _Staged:
    descriptor: int
    temporary: Path
    path: Path
    last: bool


class AtomicFiles:
    """Files that are flushed to the disk together, which is faster than one at a time; each is complete or absent.

    `add` writes a temporary file, `commit` flushes and renames all of them. For use from one thread.
    """

    def __init__(self) -> None:
        self._staged: list[_Staged] = []

    def __len__(self) -> int:
        return len(self._staged)

    def add(self, path: Path, data: bytes, *, last: bool = False) -> None:
        """Write a temporary file for `path`.

        Args:
            path: The file to create or replace; its folder must exist.
            data: Content of the file.
            last: The file marks the others as complete: it is renamed last, with the content of all on the disk.

        Raises:
            OSError: It cannot be written; the files added before are not affected.
        """
        descriptor, temporary = _create_temporary(path, 0o666)
        self._staged.append(_Staged(descriptor, temporary, path, last))
        try:
            with os.fdopen(descriptor, "wb", closefd=False) as file:
                file.write(data)
        except BaseException:
            self.drop_from(len(self._staged) - 1)
            raise

    def drop_from(self, first: int) -> None:
        """Discard the files added from number `first` on."""
        dropped, self._staged = self._staged[first:], self._staged[:first]
        for staged in dropped:
            os.close(staged.descriptor)
            staged.temporary.unlink(missing_ok=True)

    def commit(self) -> None:
        """Flush all files to the disk and rename them; the list is empty afterwards.

        Raises:
            OSError: They cannot be written. Each file is complete or unchanged; files added with `last` are only
                renamed after all others, and deleted if a folder cannot be written.
        """
        try:
            for staged in self._staged:
                # Start to write all of them before waiting for the first.
                os.posix_fadvise(staged.descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
            for staged in self._staged:
                os.fsync(staged.descriptor)
            # A file system with a journal keeps the order of the renames.
            for staged in sorted(self._staged, key=lambda staged: staged.last):
                staged.temporary.replace(staged.path)
            try:
                for folder in sorted({staged.path.parent for staged in self._staged}):
                    sync_folder(folder)
            except OSError:
                for staged in self._staged:
                    if staged.last:
                        staged.path.unlink(missing_ok=True)  # the others may not be on the disk
                raise
        finally:
            self.drop_from(0)


def write_new(path: Path, data: bytes, mode: int = PRIVATE_FILE) -> None:
    """Write a file that must not exist, never readable by more users than `mode` allows.

    Raises:
        FileExistsError: It exists.
        OSError: It cannot be written.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, PRIVATE_FILE)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
        file.flush()
        os.fchmod(file.fileno(), mode)
        os.fsync(file.fileno())


def write_new_folder(path: Path, files: Mapping[str, tuple[bytes, int]]) -> None:
    """Create a private folder with files, complete or not at all.

    Args:
        path: The folder; it must not exist.
        files: Content and mode of each file, by name.

    Raises:
        FileExistsError: `path` exists.
        OSError: It cannot be written.
    """
    if path.exists() or path.is_symlink():
        raise FileExistsError(f"{path} exists")
    if not path.parent.is_dir():
        path.parent.mkdir(parents=True)
        path.parent.chmod(PRIVATE_FOLDER)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        temporary.chmod(PRIVATE_FOLDER)
        for name, (data, mode) in files.items():
            write_new(temporary / name, data, mode)
        sync_folder(temporary)
        # Fails if another process has created a folder with content in the meantime.
        temporary.rename(path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Flush a folder to the disk, which makes a rename in it durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
