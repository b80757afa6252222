"""A file that is read piece by piece, held to be the same from the first byte to the last."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Final

from sonarpost.errors import SurveyFileError

_BUFFER_BYTES: Final = 1 << 18
_LINE_BYTES: Final = 1 << 16


class CheckedFile:
    """A regular file opened once. A file put in its place later is not seen; one rewritten in place is an error.

    Raises:
        SurveyFileError: It cannot be opened, or is not a regular file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            # Without blocking: a named pipe in the survey folder must not hold up the service.
            self._descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except (OSError, ValueError) as error:  # ValueError: a zero byte in the name
            what = getattr(error, "strerror", None) or str(error)
            raise SurveyFileError(str(path), "", what, "a readable survey file") from error
        status = os.fstat(self._descriptor)
        self._stamp = (status.st_size, status.st_mtime_ns)
        self.size_bytes = status.st_size
        if not stat.S_ISREG(status.st_mode):
            self.close()
            raise SurveyFileError(str(path), "", "not a regular file", "a survey file")

    def read_at(self, offset: int, count: int, place: str) -> bytes:
        """Return `count` bytes from `offset`.

        Raises:
            SurveyFileError: The file ends before, or cannot be read; the message names `place`.
        """
        if offset + count > self.size_bytes:
            left = max(self.size_bytes - offset, 0)
            raise self.error(place, f"{left} bytes left", f"{count} bytes: the file is truncated")
        pieces = []
        while count:
            try:
                piece = os.pread(self._descriptor, count, offset)
            except OSError as error:
                raise self.error(place, error.strerror or str(error), "a readable file") from error
            if not piece:
                raise self.error(place, f"{count} bytes fewer", "all bytes: the file shrank while it was read")
            pieces.append(piece)
            offset, count = offset + len(piece), count - len(piece)
        return b"".join(pieces)

    def text_lines(self) -> Iterator[str]:
        """Yield the lines of a UTF-8 text, each with its end; a byte order mark is left out.

        Raises:
            SurveyFileError: Not UTF-8, a line over 64 KiB, or the file cannot be read; the message names the line.
        """
        walk = SequentialReader(self)
        rest = b""
        number = 0
        while walk.left or rest:
            rest += walk.take(min(_LINE_BYTES, walk.left), f"line {number + 1}")
            *lines, rest = rest.split(b"\n")
            if not walk.left:
                lines, rest = [*lines, rest] if rest else lines, b""
            elif len(rest) > _LINE_BYTES:
                lines = [*lines, rest]  # its end has not come yet, and is not waited for
            for line in lines:
                number += 1
                if len(line) > _LINE_BYTES:
                    raise self.error(f"line {number}", f"over {_LINE_BYTES} bytes", "shorter lines")
                try:
                    yield line.decode("utf-8-sig" if number == 1 else "utf-8") + "\n"
                except UnicodeDecodeError as error:
                    raise self.error(f"line {number}", str(error), "UTF-8") from error

    def check_unchanged(self) -> None:
        """Raise when the file has been written to since it was opened: what was read may be of two recordings.

        Raises:
            SurveyFileError: Its size or its time of change is another.
        """
        status = os.fstat(self._descriptor)
        if (status.st_size, status.st_mtime_ns) != self._stamp:
            raise self.error("file", "changed while it was read", "a finished recording")

    def error(self, field: str, value: object, expected: str) -> SurveyFileError:
        """Return the error that names this file."""
        return SurveyFileError(str(self.path), field, value, expected)

    def close(self) -> None:
        """Close the file; more than once does no harm."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> CheckedFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        if hasattr(self, "_descriptor"):
            self.close()


class SequentialReader:
    """A position that moves through an open file; several may walk one file at a time."""

    def __init__(self, file: CheckedFile, offset: int = 0) -> None:
        self._file = file
        self.offset = offset
        self._buffer = b""
        self._buffer_offset = offset

    @property
    def left(self) -> int:
        """Bytes between here and the end."""
        return self._file.size_bytes - self.offset

    def take(self, count: int, place: str) -> bytes:
        """Return the next `count` bytes and move on.

        Raises:
            SurveyFileError: The file ends before; the message names `place`.
        """
        start = self.offset - self._buffer_offset
        if start + count > len(self._buffer):
            ahead = max(count, min(_BUFFER_BYTES, self.left))
            self._buffer = self._file.read_at(self.offset, ahead, place)
            self._buffer_offset, start = self.offset, 0
        self.offset += count
        return self._buffer[start : start + count]
