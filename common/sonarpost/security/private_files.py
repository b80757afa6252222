"""Files and folders that nobody but their owner may read, whatever the umask says."""

from __future__ import annotations

import fcntl
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from sonarpost.files import sync_folder

PRIVATE_FILE = 0o600
PUBLIC_FILE = 0o644
PRIVATE_FOLDER = 0o700


def write_new_folder(path: Path, files: Mapping[str, tuple[bytes, int]]) -> None:
    """Make a folder with files in it, whole or not at all; never touch one that is there.

    Args:
        path: The folder to make.
        files: Name of each file to its content and mode.

    Raises:
        FileExistsError: `path` is there already.
        OSError: It cannot be written.
    """
    if path.exists() or path.is_symlink():
        raise FileExistsError(f"{path} is there already")
    if not path.parent.is_dir():
        path.parent.mkdir(parents=True)
        path.parent.chmod(PRIVATE_FOLDER)
    # The name under which it is found later is given to it when it is complete.
    draft = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        draft.chmod(PRIVATE_FOLDER)
        for name, (content, mode) in files.items():
            write_new(draft / name, content, mode)
        sync_folder(draft)
        # A rename onto a folder that appeared meanwhile fails, unless that folder is empty.
        draft.rename(path)
    except BaseException:
        for name in files:
            (draft / name).unlink(missing_ok=True)
        if draft.is_dir():
            draft.rmdir()
        raise
    sync_folder(path.parent)


def write_new(path: Path, content: bytes, mode: int = PRIVATE_FILE) -> None:
    """Write a file that must not be there yet, with exactly this mode from its first byte on.

    Raises:
        FileExistsError: It is there already.
        OSError: It cannot be written.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, PRIVATE_FILE)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)
        file.flush()
        os.fchmod(file.fileno(), mode)
        os.fsync(file.fileno())


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, so that two commands at once do not give one number twice."""
    descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, PRIVATE_FILE)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
