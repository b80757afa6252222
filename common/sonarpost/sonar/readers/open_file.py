"""Reading of a survey file in parts, with checks for truncation and for changes during reading."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from sonarpost.errors import SurveyFileError
from sonarpost.files import open_regular

_BUFFER_BYTES: Final = 1 << 18
_LINE_BYTES: Final = 1 << 16


class CheckedFile:
    """An open regular file. A file that replaces it later is ignored; a file rewritten in place is an error.

    Raises:
        SurveyFileError: The file cannot be opened, or is not a regular file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._descriptor = open_regular(path)
        except OSError as error:
            raise SurveyFileError(str(path), "", error.strerror or str(error), "a readable survey file") from error
        status = os.fstat(self._descriptor)
        self._stamp = (status.st_size, status.st_mtime_ns)
        self.size_bytes = status.st_size

    def read_at(self, offset: int, count: int, place: str) -> bytes:
        """Return `count` bytes from `offset`.

        Raises:
            SurveyFileError: The file is shorter or cannot be read; the message contains `place`.
        """
        if offset + count > self.size_bytes:
            remaining = max(self.size_bytes - offset, 0)
            raise self.error(place, f"{remaining} bytes left", f"{count} bytes: the file is truncated")
        parts = []
        while count:
            try:
                part = os.pread(self._descriptor, count, offset)
            except OSError as error:
                raise self.error(place, error.strerror or str(error), "a readable file") from error
            if not part:
                raise self.error(place, f"{count} bytes fewer", "all bytes: the file shrank while it was read")
            parts.append(part)
            offset, count = offset + len(part), count - len(part)
        return b"".join(parts)

    def text_lines(self) -> Iterator[str]:
        """Yield the lines of a UTF-8 text with their line ends, without a byte order mark.

        Raises:
            SurveyFileError: Not UTF-8, or a line over 64 KiB: the message contains its number. Or an unreadable file.
        """
        reader = SequentialReader(self)
        offset = number = 0
        while offset < self.size_bytes:
            block = reader.peek(offset, _LINE_BYTES + 1)
            *lines, rest = block.split(b"\n")
            offset += len(block)
            if not lines or (offset == self.size_bytes and rest):
                lines.append(rest)  # the last one, or one that is too long
            else:
                offset -= len(rest)
            for line in lines:
                number += 1
                if len(line) > _LINE_BYTES:
                    raise self.error(f"line {number}", f"over {_LINE_BYTES} bytes", "shorter lines")
                try:
                    yield line.decode("utf-8-sig" if number == 1 else "utf-8") + "\n"
                except UnicodeDecodeError as error:
                    raise self.error(f"line {number}", str(error), "UTF-8") from error

    def check_unchanged(self) -> None:
        """Check that the file was not written to since it was opened.

        Raises:
            SurveyFileError: Its size or modification time has changed.
        """
        status = os.fstat(self._descriptor)
        if (status.st_size, status.st_mtime_ns) != self._stamp:
            raise self.error("file", "changed while it was read", "a finished recording")

    def error(self, field: str, value: object, expected: str) -> SurveyFileError:
        """Return an error with the path of this file."""
        return SurveyFileError(str(self.path), field, value, expected)

    def close(self) -> None:
        """Close the file. Closing again has no effect."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> CheckedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        if hasattr(self, "_descriptor"):
            self.close()


class SequentialReader:
    """Buffered reading of an open file from its beginning on. Several readers may use one file at the same time."""

    def __init__(self, file: CheckedFile) -> None:
        self.file = file
        self._buffer = b""
        self._buffer_offset = 0

    def peek(self, offset: int, count: int) -> bytes:
        """Return `count` bytes from `offset`, fewer at the end of the file.

        Raises:
            SurveyFileError: The file cannot be read.
        """
        start = offset - self._buffer_offset
        count = max(min(count, self.file.size_bytes - offset), 0)
        if start >= 0 and start + count <= len(self._buffer):
            return self._buffer[start : start + count]
        if not 0 <= start <= len(self._buffer):
            return self.file.read_at(offset, count, f"byte {offset}")  # elsewhere: what is buffered is still needed
        ahead = max(count, min(_BUFFER_BYTES, self.file.size_bytes - offset))
        self._buffer, self._buffer_offset = self.file.read_at(offset, ahead, f"byte {offset}"), offset
        return self._buffer[:count]
