"""Tiles that grow in number, with an exact search for the nearest over all pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sonarpost.codec.vq.tile_search import BLOCK_TILES, NearestSearch, empty_blocks, fill_blocks, squared_norms
from sonarpost.codec.vq.tiles import Tiles

_CENTRE = 128
_QUERY_ROWS = 256
_CHUNK_TILES = 256
_POOL_TILES = 4096

FloatArray = npt.NDArray[np.float32]
Distances = npt.NDArray[np.float64]


class IncrementalTileSet:
    """Tiles that grow, with an exact nearest search over all pixels.

    Pixels are held centred on 128. Products of two tiles of at most 32 x 32 px then never exceed 2^24, so that sums of
    them are exact in single precision too, and the result does not depend on the machine.

    Memory: 5 bytes a pixel of all tiles (single precision for the search, and the pixels), three times that for a
    moment while room for more is made, and 2 MiB for a search whatever the number of tiles asked for.
    """

    def __init__(self, tile_px: int, capacity: int) -> None:
        self.tile_px = tile_px
        self.capacity = capacity
        self._count = 0
        room = min(capacity, BLOCK_TILES)
        self._vectors = np.zeros((room, tile_px * tile_px), dtype=np.int8)
        self._norms = np.zeros(room)
        self._keys = np.zeros(room)
        self._blocks = empty_blocks(1, tile_px * tile_px)

    def __len__(self) -> int:
        return self._count

    @property
    def full(self) -> bool:
        """Whether no further tile fits."""
        return self._count >= self.capacity

    def tiles(self) -> Tiles:
        """Return the tiles, shape (n, pixels), uint8, in the order they were added."""
        return _uncentred(self._vectors[: self._count])

    def tiles_at(self, index: npt.NDArray[np.int64]) -> Tiles:
        """Return the tiles of these indices, shape (m, pixels), uint8."""
        return _uncentred(self._vectors[index])

    def append(self, tiles: Tiles) -> None:
        """Add tiles, shape (m, pixels), uint8. The caller keeps to the capacity."""
        end = self._count + tiles.shape[0]
        self._make_room(end)
        part = slice(self._count, end)
        self._vectors[part] = _centred(tiles)
        self._norms[part] = squared_norms(self._vectors[part])
        self._keys[part] = _brightness(tiles, self.tile_px)
        fill_blocks(self._blocks, self._count, self._vectors[part], self._norms[part])
        self._count = end

    def nearest(self, tiles: Tiles) -> tuple[npt.NDArray[np.int64], Distances]:
        """Return index and squared distance of the nearest tile (the lowest index of equals) for each of `tiles`."""
        search = self._search()
        index = np.empty(tiles.shape[0], dtype=np.int64)
        squared = np.empty(tiles.shape[0])
        for start in range(0, tiles.shape[0], _QUERY_ROWS):
            part = slice(start, start + _QUERY_ROWS)
            queries = _centred(tiles[part]).astype(np.float64)
            found, distances = search.nearest(queries, _brightness(tiles[part], self.tile_px), 1)
            index[part], squared[part] = found[:, 0], distances[:, 0]
        return index, squared

    def add_far(self, tiles: Tiles, squared_distance: Distances, above: float) -> Tiles:
        """Add, in order, each tile farther than `above` from all tiles, those just added included.

        Args:
            tiles: Shape (m, pixels), uint8.
            squared_distance: Shape (m,), squared distance of each to its nearest present tile.
            above: Distance that must be exceeded; 0 still refuses exact duplicates.

        Returns:
            The added tiles, shape (0..m, pixels), uint8.
        """
        far = np.flatnonzero(squared_distance > above * above)
        room = self.capacity - self._count
        chosen: list[int] = []
        for start in range(0, far.size, _CHUNK_TILES):
            chunk = far[start : start + _CHUNK_TILES]
            least = squared_distance[chunk]
            for first in range(0, len(chosen), _POOL_TILES):
                pool = tiles[chosen[first : first + _POOL_TILES]]
                np.minimum(least, _squared_distances(tiles[chunk], pool).min(axis=1), out=least)
            between = _squared_distances(tiles[chunk], tiles[chunk])
            for position in range(chunk.size):
                if least[position] > above * above and len(chosen) < room:
                    chosen.append(int(chunk[position]))
                    np.minimum(least, between[position], out=least)
            if len(chosen) == room:
                break
        added = np.ascontiguousarray(tiles[chosen])
        self.append(added)
        return added

    def _search(self) -> NearestSearch:
        used = slice(self._count)
        blocks = self._blocks[: -(-self._count // BLOCK_TILES)]
        order = np.arange(self._count)
        return NearestSearch(blocks, order, self._vectors[used], self._norms[used], self._keys[used])

    def _make_room(self, wanted: int) -> None:
        room = self._vectors.shape[0]
        if wanted <= room:
            return
        room = min(max(wanted, 2 * room), max(self.capacity, wanted))
        for name in ("_vectors", "_norms", "_keys"):
            old = getattr(self, name)
            larger = np.zeros((room, *old.shape[1:]), dtype=old.dtype)
            larger[: self._count] = old[: self._count]
            setattr(self, name, larger)
        blocks = empty_blocks(-(-room // BLOCK_TILES), self._vectors.shape[1])
        blocks[: self._blocks.shape[0]] = self._blocks
        self._blocks = blocks


def _centred(tiles: Tiles) -> npt.NDArray[np.int8]:
    return (tiles ^ np.uint8(_CENTRE)).view(np.int8)  # the same as subtracting 128, in one byte


def _uncentred(vectors: npt.NDArray[np.int8]) -> Tiles:
    return vectors.view(np.uint8) ^ np.uint8(_CENTRE)


def _brightness(tiles: Tiles, tile_px: int) -> Distances:
    """Return the coordinate along the diagonal: tiles are no nearer than it differs."""
    return np.asarray(tiles.sum(axis=1, dtype=np.int64) / tile_px, dtype=np.float64)


def _squared_distances(one: Tiles, other: Tiles) -> Distances:
    """Return exact squared distances, shape (m, n)."""
    a, b = _centred(one), _centred(other)
    products = (a.astype(np.float32) @ b.astype(np.float32).T).astype(np.float64)
    return np.asarray(squared_norms(a)[:, None] + squared_norms(b) - 2.0 * products, dtype=np.float64)
