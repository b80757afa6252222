r"""The journal of a catalogue build: what each image added, appended as soon as it is known.

A build over hundreds of images takes minutes to hours on a small computer. Rewriting the whole database after each
image would cost megabytes every time; a record appended and forced to disk costs only its own tiles. A record that
was cut off by a crash fails its checksum, and the journal is continued from the last whole one.

Layout: `SPJOURNAL1\n`, sha256 of the plan (32 bytes), then records: round (u16), image (u32), tiles (u32), big endian,
the tiles' pixels, crc32 (u32) of all of that.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

from sonarpost.codec.tiles import Tiles
from sonarpost.errors import CatalogueError

MAGIC = b"SPJOURNAL1\n"
_RECORD = struct.Struct(">HII")
_CRC = struct.Struct(">I")


@dataclass(frozen=True)
class JournalEntry:
    """What one image added.

    Attributes:
        round_number: Which round, from 0.
        image_number: Which image of the list, from 0.
        tiles: Shape (0.., pixels), uint8.
    """

    round_number: int
    image_number: int
    tiles: Tiles


class Journal:
    """A journal file, open for appending; with a path of None it keeps nothing and costs nothing.

    Args:
        path: The file; created if it is not there.
        plan: Text of all that decides the build. Going on with another plan would give a database that no single
            plan gives, so it is refused.
        pixels: Pixels of a tile.

    Attributes:
        entries: The whole records found in the file.

    Raises:
        CatalogueError: The file is no journal, belongs to another plan, or cannot be read or written.
    """

    def __init__(self, path: Path | None, plan: str, pixels: int) -> None:
        self._path = path
        self._file: BinaryIO | None = None
        self.entries: tuple[JournalEntry, ...] = ()
        if path is not None:
            try:
                self._file = self._open(path, MAGIC + hashlib.sha256(plan.encode()).digest(), pixels)
            except OSError as error:
                raise CatalogueError(str(path), "", str(error), "a journal that can be read and written") from error

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    def append(self, entry: JournalEntry) -> None:
        """Write one record and force it to disk.

        Raises:
            CatalogueError: It cannot be written (full disk).
        """
        if self._file is None:
            return
        record = _RECORD.pack(entry.round_number, entry.image_number, entry.tiles.shape[0]) + entry.tiles.tobytes()
        try:
            self._file.write(record + _CRC.pack(zlib.crc32(record)))
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise CatalogueError(str(self._path), "", str(error), "a journal that can be written") from error

    def _open(self, path: Path, start: bytes, pixels: int) -> BinaryIO:
        data = path.read_bytes() if path.exists() else b""
        if data[: len(start)] != start[: len(data)]:
            if data[: len(MAGIC)] != MAGIC:
                raise CatalogueError(str(path), "magic", data[: len(MAGIC)], repr(MAGIC))
            expected = "this build's images, rounds and tile size (remove the journal to start anew)"
            raise CatalogueError(str(path), "plan", data[len(MAGIC) : len(start)].hex(), expected)
        entries, end = _parse(data, len(start), pixels)
        self.entries = tuple(entries)
        file = path.open("r+b" if data else "w+b")
        if len(data) < len(start):  # new, or cut off while its first bytes were written
            file.write(start)
        else:
            file.truncate(end)
            file.seek(end)
        return file


def _parse(data: bytes, start: int, pixels: int) -> tuple[list[JournalEntry], int]:
    """Return the whole records and where the last of them ends."""
    entries: list[JournalEntry] = []
    end = start
    while len(data) - end >= _RECORD.size + _CRC.size:
        round_number, image_number, count = _RECORD.unpack_from(data, end)
        body_end = end + _RECORD.size + count * pixels
        if body_end + _CRC.size > len(data):
            break
        if zlib.crc32(data[end:body_end]) != _CRC.unpack_from(data, body_end)[0]:
            break
        tiles = np.frombuffer(data, np.uint8, count * pixels, end + _RECORD.size).reshape(count, pixels)
        entries.append(JournalEntry(round_number, image_number, tiles))
        end = body_end + _CRC.size
    return entries, end
