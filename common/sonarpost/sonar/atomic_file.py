"""Writing a whole file or nothing: a reader never meets half of it, and a power cut leaves the old one."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from sonarpost.errors import SurveyFileError


def write_atomically(path: Path, content: bytes) -> None:
    """Write `content` to `path` through a temporary file in the same folder, fsync and rename.

    Args:
        path: The file to create or replace. Its folder must exist.
        content: Everything the file shall hold.

    Raises:
        SurveyFileError: The folder is missing, not writable or full.
    """
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp")
    except OSError as error:
        raise _cannot_write(path, error) from error
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            # mkstemp makes the file private; a survey is meant to be read by the other services.
            os.fchmod(file.fileno(), 0o644)
            os.fsync(file.fileno())
        Path(temporary).replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        Path(temporary).unlink(missing_ok=True)
        raise _cannot_write(path, error) from error


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable: it lives in the folder, not in the file."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _cannot_write(path: Path, error: OSError) -> SurveyFileError:
    return SurveyFileError(str(path), "", error.strerror or str(error), "a file that can be written")
