r"""The journal of a codebook build: the result of each image and refinement pass, appended when it is known.

A build over hundreds of images takes minutes to hours. Rewriting the whole database after each image would write
megabytes every time; a record contains only the new tiles and is forced to disk. A record truncated by a crash fails
its checksum, and the journal continues after the last valid record.

Layout: `SPJOURNAL2\n`, SHA-256 of the build's fingerprint (32 bytes), then records: kind (u8: 0 image, 1 refinement
pass), round from 0 or pass from 1 (u16), image number from 0 (u32; 0 for a pass), number of tiles (u32), big endian,
SHA-256 of the source pixels (32 bytes), pixels of the tiles, CRC-32 (u32) of the record before it. Records are read one
at a time, so a journal may be larger than memory.
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
from typing import BinaryIO

import numpy as np

from sonarpost.codec.vq.tiles import Tiles
from sonarpost.errors import CodebookError

MAGIC = b"SPJOURNAL2\n"
_RECORD = struct.Struct(">BHII32s")
_CRC = struct.Struct(">I")


class EntryKind(IntEnum):
    """Source of the tiles of a record."""

    IMAGE = 0
    PASS = 1


@dataclass(frozen=True)
class BuildEntry:
    """The tiles that one image added, or all tiles after a refinement pass.

    Attributes:
        kind: Image or pass.
        number: Round, from 0, or pass, from 1.
        image_number: Position in the list of images, from 0; 0 for a pass.
        pixels_hash: SHA-256 of the image's pixels, or over the hashes of all images.
        tiles: Shape (0.., pixels), uint8.
    """

    kind: EntryKind
    number: int
    image_number: int
    pixels_hash: bytes
    tiles: Tiles


class BuildJournal:
    """A journal file, open for appending. Without a path, a journal that stores nothing.

    Args:
        path: The file, created if it does not exist.
        fingerprint: Arguments of the build as text. A journal with another fingerprint is rejected, because no single
            set of arguments would give the resulting database.
        tile_pixels: Pixels of a tile.

    Raises:
        CodebookError: The file is not a journal, belongs to another build, or cannot be read or written.
    """

    def __init__(self, path: Path | None, fingerprint: str, tile_pixels: int) -> None:
        self._path = path
        self._tile_pixels = tile_pixels
        self._file: BinaryIO | None = None
        self._start = len(MAGIC) + hashlib.sha256().digest_size
        if path is not None:
            try:
                self._file = self._open(path, MAGIC + hashlib.sha256(fingerprint.encode()).digest())
            except OSError as error:
                raise CodebookError(str(path), "", str(error), "a journal that can be read and written") from error

    def __enter__(self) -> BuildJournal:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    @property
    def name(self) -> str:
        """The file's path, for messages."""
        return str(self._path)

    def entries(self) -> Iterator[BuildEntry]:
        """Yield the complete records in order. Do not append during the iteration.

        Raises:
            CodebookError: The file cannot be read.
        """
        if self._file is None:
            return
        try:
            self._file.seek(self._start)
            yield from _records(self._file, self._tile_pixels)
            self._file.seek(0, os.SEEK_END)
        except OSError as error:
            raise CodebookError(self.name, "", str(error), "a journal that can be read") from error

    def append(self, entry: BuildEntry) -> None:
        """Write one record and force it to disk.

        Raises:
            CodebookError: It cannot be written (disk full).
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
            actual = file.read(len(start))
            _check_start(str(path), actual, start)
            if len(actual) < len(start):  # new, or truncated in its first bytes
                file.seek(0)
                file.write(start)
            else:
                end = len(start)
                for _ in _records(file, self._tile_pixels):
                    end = file.tell()
                file.seek(end)
                file.truncate()
        except BaseException:
            file.close()
            raise
        return file


def _check_start(where: str, actual: bytes, start: bytes) -> None:
    if actual != start[: len(actual)]:
        if actual[: len(MAGIC)] != MAGIC[: len(actual)]:
            raise CodebookError(where, "magic", actual[: len(MAGIC)], repr(MAGIC))
        expected = "this build's images, rounds and tile size (remove the journal to start over)"
        raise CodebookError(where, "fingerprint", actual[len(MAGIC) :].hex(), expected)


def _records(file: BinaryIO, tile_pixels: int) -> Iterator[BuildEntry]:
    """Yield the complete records from the current position. The position is after each record when it is yielded."""
    size = os.fstat(file.fileno()).st_size
    while True:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return
        kind, number, image_number, count, pixels_hash = _RECORD.unpack(head)
        if count * tile_pixels + _CRC.size > size - file.tell():  # a damaged count must not allocate gigabytes
            return
        body = file.read(count * tile_pixels)
        if zlib.crc32(body, zlib.crc32(head)) != _CRC.unpack(file.read(_CRC.size))[0] or kind not in tuple(EntryKind):
            return
        tiles = np.frombuffer(body, np.uint8).reshape(count, tile_pixels)
        yield BuildEntry(EntryKind(kind), number, image_number, pixels_hash, tiles)
