"""Codebook files and the shipped codebooks; docs/specifications/codebook-file.md specifies the file.

Everything in the file is stored plainly, not compressed, so the same database and notes are the same bytes on every
machine and with every version of every library.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np

from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import MAX_DIMS, MAX_TILE_PX, MIN_TILE_PX, TileDatabase
from sonarpost.errors import CodebookError
from sonarpost.files import write_atomically

MAGIC = b"SPTILES\n"
VERSION = 1
DEFAULT_TILE_PX = (10, 20)

_HEADER = struct.Struct(">8sHHIHI")  # magic, version, tile_px, tiles, dims, bytes of notes
_HASH_BYTES = 32
MAX_NOTES_BYTES = 1 << 20


@dataclass(frozen=True)
class Codebook:
    """A tile database with notes about where it comes from.

    Attributes:
        tiles: The database.
        notes: What people want to know of it (source, licence, rounds); no part of the identity.
    """

    tiles: TileDatabase
    notes: Mapping[str, str]


def to_bytes(codebook: Codebook) -> bytes:
    """Return the file's bytes.

    Raises:
        CodebookError: The notes take more than 1 MiB.
    """
    tiles = codebook.tiles
    notes = json.dumps(dict(codebook.notes), sort_keys=True, ensure_ascii=False).encode()
    if len(notes) > MAX_NOTES_BYTES:
        raise CodebookError("tile codebook", "notes", f"{len(notes)} B", f"at most {MAX_NOTES_BYTES} B")
    header = _HEADER.pack(MAGIC, VERSION, tiles.tile_px, len(tiles), tiles.dims, len(notes))
    content = b"".join(
        (header, notes, tiles.mean.tobytes(), tiles.basis.astype(">i2").tobytes(), tiles.tiles.tobytes())
    )
    return content + hashlib.sha256(content).digest()


def from_bytes(data: bytes, where: str) -> Codebook:
    """Parse a codebook.

    Args:
        data: The whole file.
        where: Its name, for messages.

    Raises:
        CodebookError: Not a codebook, of another version, cut off, or damaged (the sha256 at its end differs).
    """
    if len(data) < _HEADER.size + _HASH_BYTES:
        raise CodebookError(where, "", f"{len(data)} B", f"a tile codebook of at least {_HEADER.size + 32} B")
    magic, version, tile_px, count, dims, notes_bytes = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise CodebookError(where, "magic", magic, repr(MAGIC))
    if version != VERSION:
        raise CodebookError(where, "version", version, f"{VERSION}, the only one this release reads")
    if not MIN_TILE_PX <= tile_px <= MAX_TILE_PX:
        raise CodebookError(where, "tile_px", tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX}")
    if not 1 <= dims <= min(MAX_DIMS, tile_px * tile_px):
        raise CodebookError(where, "dims", dims, f"1..{min(MAX_DIMS, tile_px * tile_px)}")
    if count < 1:
        raise CodebookError(where, "tiles", count, "at least 1")
    pixels = tile_px * tile_px
    sizes = (_HEADER.size, notes_bytes, pixels, dims * pixels * 2, count * pixels, _HASH_BYTES)
    if len(data) != sum(sizes):
        raise CodebookError(where, "length", f"{len(data)} B", f"{sum(sizes)} B, as its header says")
    if hashlib.sha256(data[:-_HASH_BYTES]).digest() != data[-_HASH_BYTES:]:
        raise CodebookError(where, "sha256", data[-_HASH_BYTES:].hex(), "the hash of the content (the file is damaged)")
    ends = np.cumsum(sizes)
    mean = np.frombuffer(data, np.uint8, pixels, int(ends[1]))
    basis = np.frombuffer(data, ">i2", dims * pixels, int(ends[2])).reshape(dims, pixels)
    tiles = np.frombuffer(data, np.uint8, count * pixels, int(ends[3])).reshape(count, pixels)
    notes = _parse_notes(data[_HEADER.size : int(ends[1])], where)
    return Codebook(TileDatabase(tile_px, tiles, mean, basis.astype(np.int16)), notes)


def _parse_notes(data: bytes, where: str) -> dict[str, str]:
    expected = "a JSON object of strings"
    try:
        notes = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise CodebookError(where, "notes", data, expected) from error
    if not isinstance(notes, dict) or not all(isinstance(value, str) for value in notes.values()):
        raise CodebookError(where, "notes", notes, expected)
    return notes


def save(path: Path, codebook: Codebook) -> None:
    """Write a codebook atomically.

    Raises:
        CodebookError: It cannot be written.
    """
    try:
        write_atomically(path, to_bytes(codebook))
    except OSError as error:
        raise CodebookError(str(path), "", str(error), "a place that can be written to") from error


def load(path: Path) -> Codebook:
    """Read a codebook and verify its hash.

    Raises:
        CodebookError: The file cannot be read or is damaged.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CodebookError(str(path), "", str(error), "a tile codebook file") from error
    return from_bytes(data, str(path))


@cache
def load_default(tile_px: int) -> Codebook:
    """Return the codebook shipped with the package for tiles of 10 or 20 px; kept in memory after the first call.

    Raises:
        CodebookError: There is none for that size, or the installed file is damaged.
    """
    if tile_px not in DEFAULT_TILE_PX:
        sizes = " or ".join(str(size) for size in DEFAULT_TILE_PX)
        raise CodebookError("nominal codebooks", "tile_px", tile_px, sizes)
    name = f"nominal-{tile_px}.tiles"
    try:
        data = (resources.files("sonarpost.codec.vq") / "data" / name).read_bytes()
    except OSError as error:
        raise CodebookError(name, "", str(error), "the file installed with the package") from error
    return from_bytes(data, name)


def open_codebook(name_or_path: str) -> Codebook:
    """Return a shipped codebook by its name (`nominal-10`, `nominal-20`) or any other by its path.

    Raises:
        CodebookError: It cannot be read.
    """
    for tile_px in DEFAULT_TILE_PX:
        if name_or_path == f"nominal-{tile_px}":
            return load_default(tile_px)
    return load(Path(name_or_path))


def default_for_tag(tag: int) -> Codebook:
    """Return the shipped codebook whose identity has the 16-bit tag that a stream header carries.

    Raises:
        CodebookError: The stream was made with a codebook that is not one of the shipped ones.
    """
    tags = {}
    for tile_px in DEFAULT_TILE_PX:
        codebook = load_default(tile_px)
        own = codebook_tag(codebook.tiles)
        if own == tag:
            return codebook
        tags[f"nominal-{tile_px}"] = own
    known = ", ".join(f"{own:#06x} ({name})" for name, own in tags.items())
    raise CodebookError("stream", "model_tag", f"{tag:#06x}", f"one of {known}, or the codebook it was made with")
