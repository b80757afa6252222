"""Codebook files, the shipped codebooks, and the search for the codebook of a stream.

docs/specifications/codebook-file.md specifies the file. Nothing in it is compressed: the same database and notes give
the same bytes with every version of every library.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np

from sonarpost.codec.vq.codec import codebook_tag
from sonarpost.codec.vq.tiles import MAX_DIMS, MAX_TILE_PX, MIN_TILE_PX, TileDatabase
from sonarpost.errors import CodebookError
from sonarpost.files import read_regular

MAGIC = b"SPTILES\n"
VERSION = 1
DEFAULT_TILE_PX = (10, 20)
SEARCH_PATH_VARIABLE: Final = "SONARPOST_CODEBOOKS"
"""Environment variable: files and folders to search for the codebook of a stream, separated by `os.pathsep`."""
SUFFIX: Final = ".tiles"

_HEADER = struct.Struct(">8sHHIHI")  # magic, version, tile_px, tiles, dims, bytes of notes
_HASH_BYTES = 32
MAX_NOTES_BYTES = 1 << 20
MAX_FILE_BYTES = 1 << 28


@dataclass(frozen=True)
class Codebook:
    """A tile database with notes about its origin.

    Attributes:
        tiles: The database.
        notes: Information for people (source, licence, rounds); not part of the identity.
    """

    tiles: TileDatabase
    notes: Mapping[str, str]


def to_bytes(codebook: Codebook) -> bytes:
    """Return the content of a codebook file.

    Raises:
        CodebookError: The notes exceed 1 MiB.
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
    """Parse the content of a codebook file.

    `where` names the file in messages.

    Raises:
        CodebookError: Not a codebook, another version, truncated, or damaged (the SHA-256 at its end differs).
    """
    if len(data) < _HEADER.size + _HASH_BYTES:
        raise CodebookError(where, "", f"{len(data)} B", f"a tile codebook of at least {_HEADER.size + 32} B")
    magic, version, tile_px, count, dims, notes_bytes = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise CodebookError(where, "magic", magic, repr(MAGIC))
    if version != VERSION:
        raise CodebookError(where, "version", version, f"{VERSION}, the only version that this release reads")
    if not MIN_TILE_PX <= tile_px <= MAX_TILE_PX:
        raise CodebookError(where, "tile_px", tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX}")
    if not 1 <= dims <= min(MAX_DIMS, tile_px * tile_px):
        raise CodebookError(where, "dims", dims, f"1..{min(MAX_DIMS, tile_px * tile_px)}")
    if count < 1:
        raise CodebookError(where, "tiles", count, "at least 1")
    pixels = tile_px * tile_px
    sizes = (_HEADER.size, notes_bytes, pixels, dims * pixels * 2, count * pixels, _HASH_BYTES)
    if len(data) != sum(sizes):
        raise CodebookError(where, "length", f"{len(data)} B", f"{sum(sizes)} B, according to its header")
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


def load(path: Path) -> Codebook:
    """Read a codebook file and verify its hash.

    Raises:
        CodebookError: The file cannot be read or is damaged.
    """
    try:
        data = read_regular(path, MAX_FILE_BYTES)
    except OSError as error:
        raise CodebookError(str(path), "", str(error), "a tile codebook file") from error
    return from_bytes(data, str(path))


@cache
def load_default(tile_px: int) -> Codebook:
    """Return the shipped codebook for tiles of 10 or 20 px. It stays in memory after the first call.

    Raises:
        CodebookError: No codebook of that size is shipped, or the installed file is damaged.
    """
    if tile_px not in DEFAULT_TILE_PX:
        sizes = " or ".join(str(size) for size in DEFAULT_TILE_PX)
        raise CodebookError("nominal codebooks", "tile_px", tile_px, sizes)
    name = f"nominal-{tile_px}{SUFFIX}"
    try:
        data = (resources.files("sonarpost.codec.vq") / "data" / name).read_bytes()
    except OSError as error:
        raise CodebookError(name, "", str(error), "the file installed with the package") from error
    return from_bytes(data, name)


def open_codebook(name_or_path: str | Path) -> Codebook:
    """Return a shipped codebook by name (`nominal-10`, `nominal-20`) or any other by path.

    Raises:
        CodebookError: The codebook cannot be read.
    """
    for tile_px in DEFAULT_TILE_PX:
        if name_or_path == f"nominal-{tile_px}":
            return load_default(tile_px)
    return load(Path(name_or_path))


def find_codebook(tag: int, search_path: Sequence[str | Path] = ()) -> Codebook:
    """Return the codebook with the tag of a stream header.

    The order of the search is: `search_path`, the shipped codebooks, the files and folders of the environment variable
    SONARPOST_CODEBOOKS. Of a folder, the `.tiles` files are searched.

    Args:
        tag: The 16 bits of the codebook's identity in the stream header.
        search_path: Names of shipped codebooks, files or folders.

    Raises:
        CodebookError: No codebook has this tag, or two of one source have it. The message names the tag and the places
            searched.
    """
    variable = os.environ.get(SEARCH_PATH_VARIABLE, "")
    searched: list[str] = []
    shipped = [f"nominal-{tile_px}" for tile_px in DEFAULT_TILE_PX]
    for source in (search_path, shipped, [part for part in variable.split(os.pathsep) if part]):
        found: dict[str, Codebook] = {}
        for name in _codebook_names(source):
            try:
                codebook = _open_cached(name)
            except CodebookError:
                searched.append(f"{name} (unreadable)")
                continue
            own_tag = codebook_tag(codebook.tiles)
            searched.append(f"{name} ({own_tag:#06x})")
            if own_tag == tag:
                found[codebook.tiles.identity] = codebook
        if len(found) > 1:
            expected = f"one codebook with this tag among {', '.join(searched)}"
            raise CodebookError("stream", "model_tag", f"{tag:#06x}", expected)
        if found:
            return next(iter(found.values()))
    expected = f"the tag of a codebook. Searched: {', '.join(searched)}. {SEARCH_PATH_VARIABLE} adds files and folders"
    raise CodebookError("stream", "model_tag", f"{tag:#06x}", expected)


def _codebook_names(source: Sequence[str | Path]) -> Iterator[str]:
    for name in source:
        if Path(name).is_dir():
            yield from (str(path) for path in sorted(Path(name).glob(f"*{SUFFIX}")))
        else:
            yield str(name)


def _open_cached(name: str) -> Codebook:
    """Return a codebook; a file is read again only when its size or modification time has changed."""
    try:
        status = Path(name).stat()
    except OSError:
        return open_codebook(name)
    return _open_version(name, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=8)
def _open_version(name: str, _mtime_ns: int, _size: int) -> Codebook:
    return open_codebook(name)
