"""Writer of cloud-optimised GeoTIFF: grey images of any size, tile by tile.

The file contains the image and its overviews, each half the size of the one before, down to one tile. All directories
are at the beginning and the smallest overview is the first data, so that a reader of a part needs few requests. Tiles
are compressed (Deflate). Above 4 GB the file is a BigTIFF. Structures: TIFF 6.0, OGC GeoTIFF 1.1, and the layout of
GDAL's cloud-optimised GeoTIFF driver. `tifffile` is not used, because it writes the directories after the data.
"""

import math
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
import numpy.typing as npt

from sonarpost.files import atomic_file

Grey = npt.NDArray[np.uint8]

TILE_PX: Final = 512
_CLASSIC_BYTES: Final = (1 << 32) - (1 << 20)
_BYTE, _ASCII, _SHORT, _LONG, _DOUBLE, _LONG8 = 1, 2, 3, 4, 12, 16
_TYPE_CODES: Final = {_BYTE: "B", _ASCII: "s", _SHORT: "H", _LONG: "I", _DOUBLE: "d", _LONG8: "Q"}
_DEFLATE: Final = 8
_REDUCED: Final = 1


@dataclass(frozen=True, slots=True)
class GeoTransform:
    """Place of an image in a projected coordinate system in metres.

    A point at column c and row r, from the upper left corner of the image, is at `origin_m` + c `column_m` + r `row_m`.

    Attributes:
        epsg: Number of the coordinate system.
        origin_m: Easting and northing of the upper left corner of the first pixel.
        column_m: Easting and northing of a step of one column.
        row_m: Easting and northing of a step of one row.
    """

    epsg: int
    origin_m: tuple[float, float]
    column_m: tuple[float, float]
    row_m: tuple[float, float]


@dataclass(slots=True)
class _Level:
    """One resolution of the image: its size, and place and length of its compressed tiles in the data."""

    height_px: int
    width_px: int
    offsets: list[int]
    lengths: list[int]

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return math.ceil(self.height_px / TILE_PX), math.ceil(self.width_px / TILE_PX)


def write_image(path: Path, image: Grey, transform: GeoTransform) -> None:
    """Write an image in memory, shape (rows, columns), uint8; 0 means no data.

    Raises:
        OSError: The file cannot be written.
    """

    def tile(row: int, column: int) -> Grey:
        part = image[row * TILE_PX : (row + 1) * TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
        return np.pad(part, ((0, TILE_PX - part.shape[0]), (0, TILE_PX - part.shape[1])))

    height_px, width_px = image.shape
    write_tiles(path, (height_px, width_px), tile, transform)


def write_tiles(
    path: Path, size_px: tuple[int, int], tile: Callable[[int, int], Grey], transform: GeoTransform
) -> None:
    """Write an image tile by tile, atomically. Temporary files beside it need up to twice its size without compression.

    Args:
        path: The file to create or replace.
        size_px: Rows and columns of the image.
        tile: Returns the tile in a row and column of tiles, shape (512, 512), uint8, 0 for no data and beyond the
            image. It is called once for each tile, in rows.
        transform: Place of the image.

    Raises:
        OSError: A file cannot be written.
    """
    levels = _levels(size_px)
    with tempfile.TemporaryFile(dir=path.parent) as raw, tempfile.TemporaryFile(dir=path.parent) as packed:
        starts = _write_raw(raw, levels, tile)
        for level, start in reversed(list(zip(levels, starts, strict=True))):
            _compress(raw, packed, level, start)
        data_bytes = packed.tell()
        packed.seek(0)
        is_big = data_bytes + len(_pack(levels, transform, 0, is_big=True)) > _CLASSIC_BYTES
        data_start = len(_pack(levels, transform, 0, is_big=is_big))
        with atomic_file(path) as out:
            out.write(_pack(levels, transform, data_start, is_big=is_big))
            shutil.copyfileobj(packed, out, 1 << 20)


def _levels(size_px: tuple[int, int]) -> list[_Level]:
    levels = [_Level(*size_px, [], [])]
    while max(levels[-1].height_px, levels[-1].width_px) > TILE_PX:
        last = levels[-1]
        levels.append(_Level(math.ceil(last.height_px / 2), math.ceil(last.width_px / 2), [], []))
    return levels


def _write_raw(raw: BinaryIO, levels: list[_Level], tile: Callable[[int, int], Grey]) -> list[int]:
    """Write all tiles of all levels without compression; return the offset of each level."""
    starts = [0]
    rows, columns = levels[0].grid
    for row in range(rows):
        raw.writelines(tile(row, column).tobytes() for column in range(columns))
    for finer, level in pairwise(levels):
        starts.append(raw.tell())
        for row in range(level.grid[0]):
            for column in range(level.grid[1]):
                reduced = _reduced(_four_tiles(raw, finer, starts[-2], row, column))
                raw.seek(0, 2)
                raw.write(reduced.tobytes())
    return starts


def _four_tiles(raw: BinaryIO, level: _Level, start: int, row: int, column: int) -> Grey:
    """Return the tiles of a finer level that a tile covers, shape (1024, 1024), 0 beyond the level."""
    four = np.zeros((2 * TILE_PX, 2 * TILE_PX), np.uint8)
    rows, columns = level.grid
    for down in (0, 1):
        for right in (0, 1):
            if 2 * row + down < rows and 2 * column + right < columns:
                part = _raw_tile(raw, start, (2 * row + down) * columns + 2 * column + right)
                four[down * TILE_PX : (down + 1) * TILE_PX, right * TILE_PX : (right + 1) * TILE_PX] = part
    return four


def _raw_tile(raw: BinaryIO, start: int, number: int) -> Grey:
    raw.seek(start + number * TILE_PX**2)
    return np.frombuffer(raw.read(TILE_PX**2), np.uint8).reshape(TILE_PX, TILE_PX)


def _reduced(image: Grey) -> Grey:
    """Return the means of blocks of two by two pixels, of those with data; 0 without."""
    blocks = image.reshape(image.shape[0] // 2, 2, image.shape[1] // 2, 2)
    count = np.count_nonzero(blocks, axis=(1, 3))
    total = blocks.sum(axis=(1, 3), dtype=np.uint32)
    means: Grey = ((total + count // 2) // np.maximum(count, 1)).astype(np.uint8)
    return means


def _compress(raw: BinaryIO, packed: BinaryIO, level: _Level, start: int) -> None:
    rows, columns = level.grid
    for number in range(rows * columns):
        content = zlib.compress(_raw_tile(raw, start, number).tobytes(), 6)
        level.offsets.append(packed.tell())
        level.lengths.append(len(content))
        packed.write(content)


_Tag = tuple[int, int, tuple[int, ...] | tuple[float, ...] | bytes]
"""Number, type and values of a tag."""


def _tags(level: _Level, transform: GeoTransform, data_start: int, *, is_reduced: bool, is_big: bool) -> list[_Tag]:
    """Return the tags of a directory in the order of their numbers."""
    place = _LONG8 if is_big else _LONG
    tags: list[_Tag] = [
        (254, _LONG, (_REDUCED if is_reduced else 0,)),
        (256, _LONG, (level.width_px,)),
        (257, _LONG, (level.height_px,)),
        (258, _SHORT, (8,)),
        (259, _SHORT, (_DEFLATE,)),
        (262, _SHORT, (1,)),  # black is zero
        (277, _SHORT, (1,)),
        (322, _SHORT, (TILE_PX,)),
        (323, _SHORT, (TILE_PX,)),
        (324, place, tuple(offset + data_start for offset in level.offsets)),
        (325, place, tuple(level.lengths)),
    ]
    if not is_reduced:
        tags += _geo_tags(transform)
    return [*tags, (42113, _ASCII, b"0\0")]  # no data


def _geo_tags(transform: GeoTransform) -> Iterator[_Tag]:
    (east_m, north_m), (cx, cy), (rx, ry) = transform.origin_m, transform.column_m, transform.row_m
    if cy == 0 == rx and cx > 0 > ry:
        yield 33550, _DOUBLE, (cx, -ry, 0.0)
        yield 33922, _DOUBLE, (0.0, 0.0, 0.0, east_m, north_m, 0.0)
    else:
        matrix = ((cx, rx, 0.0, east_m), (cy, ry, 0.0, north_m), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        yield 34264, _DOUBLE, tuple(value for line in matrix for value in line)
    # Version, number of keys; projected, pixel is area, coordinate system, metres.
    keys = (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, transform.epsg, 3076, 0, 1, 9001)
    yield 34735, _SHORT, keys


def _pack(levels: list[_Level], transform: GeoTransform, data_start: int, *, is_big: bool) -> bytes:
    """Return the header and all directories for data that begin at `data_start`, which does not change their length."""
    out = bytearray(struct.pack("<2sHHHQ", b"II", 43, 8, 0, 16) if is_big else struct.pack("<2sHI", b"II", 42, 8))
    count_code, entry_code, inline = ("Q", "Q", 8) if is_big else ("H", "I", 4)
    for number, level in enumerate(levels):
        tags = _tags(level, transform, data_start, is_reduced=number > 0, is_big=is_big)
        packed = [(tag, kind, *_packed_values(kind, values)) for tag, kind, values in tags]
        entries_bytes = struct.calcsize(f"<{count_code}") + len(packed) * (12 + 2 * (inline - 4)) + inline
        values_at = len(out) + entries_bytes
        entries, long_values = bytearray(struct.pack(f"<{count_code}", len(packed))), bytearray()
        for tag, kind, length, raw in packed:
            entries += struct.pack(f"<HH{entry_code}", tag, kind, length)
            if len(raw) <= inline:
                entries += raw.ljust(inline, b"\0")
            else:
                entries += struct.pack(f"<{entry_code}", values_at + len(long_values))
                long_values += raw + bytes(-len(raw) % 8)
        end = values_at + len(long_values)
        end += -end % 8
        is_last = number == len(levels) - 1
        entries += struct.pack(f"<{entry_code}", 0 if is_last else end)
        out += entries + long_values
        out += bytes(end - len(out))
    return bytes(out)


def _packed_values(kind: int, values: tuple[int, ...] | tuple[float, ...] | bytes) -> tuple[int, bytes]:
    """Return the number of values and their bytes."""
    if isinstance(values, bytes):
        return len(values), values
    return len(values), struct.pack(f"<{len(values)}{_TYPE_CODES[kind]}", *values)
