"""Writes codebook files."""

from __future__ import annotations

from pathlib import Path

from sonarpost.codec.vq.codebook import Codebook, to_bytes
from sonarpost.errors import CodebookError
from sonarpost.files import write_atomically


def save(path: Path, codebook: Codebook) -> None:
    """Write a codebook file atomically.

    Raises:
        CodebookError: The file cannot be written.
    """
    try:
        write_atomically(path, to_bytes(codebook))
    except OSError as error:
        raise CodebookError(str(path), "", str(error), "a writable file") from error
