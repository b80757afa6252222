r"""The journal of a codebook build: what each image added, and each refinement pass, appended as soon as it is known.

A build over hundreds of images takes minutes to hours on a small computer. Rewriting the whole database after each
image would cost megabytes every time; a record appended and forced to disk costs only its own tiles. A record that
was cut off by a crash fails its checksum, and the journal is continued from the last whole one.

Layout: `SPJOURNAL2\n`, sha256 of the plan (32 bytes), then records: kind (u8: 0 an image, 1 a refinement pass), round
from 0 or pass from 1 (u16), image from 0 (u32; 0 for a pass), tiles (u32), big endian, sha256 of the pixels they were
made from (32 bytes), the tiles' pixels, crc32 (u32) of all of that. Records are read one at a time: a journal may be
larger than memory.
"""

from __future__ import annotations

import hashlib
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import numpy as np

from sonarpost.codec.vq.tiles import Tiles
from sonarpost.errors import CodebookError

MAGIC = b"SPJOURNAL2\n"
_RECORD = struct.Struct(">BHII32s")
_CRC = struct.Struct(">I")


class EntryKind(IntEnum):
    """What a record holds the tiles of."""

    IMAGE = 0
    PASS = 1


@dataclass(frozen=True)
class JournalEntry:
    """What one image added, or all tiles as one refinement pass left them.

    Attributes:
        kind: Which of the two.
        number: Which round, from 0, or which pass, from 1.
        image_number: Which image of the list, from 0; 0 for a pass.
        pixels_hash: sha256 of the image's pixels, or over those of all images.
        tiles: Shape (0.., pixels), uint8.
    """

    kind: EntryKind
    number: int
    image_number: int
    pixels_hash: bytes
    tiles: Tiles


class Journal:
    """A journal file, open for appending; with a path of None it keeps nothing and costs nothing.

    Args:
        path: The file; created if it is not there.
        plan: Text of all that decides the build but pixels. Going on with another plan would give a database that no
            single plan gives, so it is refused.
        pixels: Pixels of a tile.

    Raises:
        CodebookError: The file is no journal, belongs to another plan, or cannot be read or written.
    """

    def __init__(self, path: Path | None, plan: str, pixels: int) -> None:
        self._path = path
        self._pixels = pixels
        self._file: BinaryIO | None = None
        self._start = len(MAGIC) + hashlib.sha256().digest_size
        if path is not None:
            try:
                self._file = self._open(path, MAGIC + hashlib.sha256(plan.encode()).digest())
            except OSError as error:
                raise CodebookError(str(path), "", str(error), "a journal that can be read and written") from error

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()

    @property
    def name(self) -> str:
        """The file's path, for messages."""
        return str(self._path)

    def entries(self) -> Iterator[JournalEntry]:
        """Yield the whole records, in the order they were written. Nothing may be appended meanwhile.

        Raises:
            CodebookError: The file cannot be read.
        """
        if self._file is None:
            return
        try:
            self._file.seek(self._start)
            yield from _records(self._file, self._pixels)
            self._file.seek(0, os.SEEK_END)
        except OSError as error:
            raise CodebookError(self.name, "", str(error), "a journal that can be read") from error

    def append(self, entry: JournalEntry) -> None:
        """Write one record and force it to disk.

        Raises:
            CodebookError: It cannot be written (full disk).
        """
        if self._file is None:
            return
        head = _RECORD.pack(entry.kind, entry.number, entry.image_number, entry.tiles.shape[0], entry.pixels_hash)
        record = head + entry.tiles.tobytes()
        try:
            self._file.write(record + _CRC.pack(zlib.crc32(record)))
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise CodebookError(self.name, "", str(error), "a journal that can be written") from error

    def _open(self, path: Path, start: bytes) -> BinaryIO:
        file = path.open("r+b" if path.exists() else "w+b")
        try:
            met = file.read(len(start))
            _check_start(str(path), met, start)
            if len(met) < len(start):  # new, or cut off while its first bytes were written
                file.seek(0)
                file.write(start)
            else:
                end = len(start)
                for _ in _records(file, self._pixels):
                    end = file.tell()
                file.seek(end)
                file.truncate()
        except BaseException:
            file.close()
            raise
        return file


def _check_start(where: str, met: bytes, start: bytes) -> None:
    if met != start[: len(met)]:
        if met[: len(MAGIC)] != MAGIC[: len(met)]:
            raise CodebookError(where, "magic", met[: len(MAGIC)], repr(MAGIC))
        expected = "this build's images, rounds and tile size (remove the journal to start anew)"
        raise CodebookError(where, "plan", met[len(MAGIC) :].hex(), expected)


def _records(file: BinaryIO, pixels: int) -> Iterator[JournalEntry]:
    """Yield the whole records from where the file stands, which is after the record whenever one is yielded."""
    size = os.fstat(file.fileno()).st_size
    while True:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return
        kind, number, image_number, count, pixels_hash = _RECORD.unpack(head)
        if count * pixels + _CRC.size > size - file.tell():  # also keeps a damaged count from asking for gigabytes
            return
        body = file.read(count * pixels)
        if zlib.crc32(body, zlib.crc32(head)) != _CRC.unpack(file.read(_CRC.size))[0] or kind not in tuple(EntryKind):
            return
        tiles = np.frombuffer(body, np.uint8).reshape(count, pixels)
        yield JournalEntry(EntryKind(kind), number, image_number, pixels_hash, tiles)
