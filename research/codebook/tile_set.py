"""A set of tiles that grows while a codebook is built, with the exact search of the codec."""

import numpy as np
import numpy.typing as npt

from sonarpost.codec.vq.tile_search import (
    GROUP,
    Distances,
    Indices,
    NearestSearch,
    empty_columns,
    fill_columns,
    squared_norms,
)
from sonarpost.codec.vq.tiles import Tiles

_CENTRE = 128
_QUERY_ROWS = 256
_CHUNK_TILES = 256
_POOL_TILES = 4096
_FIRST_TILES = 2048


class IncrementalTileSet:
    """A growing set of tiles with an exact nearest-neighbour search over all pixels.

    Pixels are stored minus 128. Sums of products of two tiles of at most 32 x 32 px then never exceed 2^24 and are
    exact in single precision, so the result does not depend on the machine.

    Memory: 5 bytes a pixel of all tiles, three times that while the arrays grow, and 2 MiB for a search.
    """

    def __init__(self, tile_px: int, capacity: int) -> None:
        self.tile_px = tile_px
        self.capacity = capacity
        self._count = 0
        allocated = min(capacity, _FIRST_TILES)
        self._vectors = np.zeros((allocated, tile_px * tile_px), dtype=np.int8)
        self._norms = np.zeros(allocated)
        self._columns = empty_columns(allocated, tile_px * tile_px)

    def __len__(self) -> int:
        return self._count

    @property
    def full(self) -> bool:
        """Whether the capacity is reached."""
        return self._count >= self.capacity

    def tiles(self) -> Tiles:
        """Return the tiles, shape (n, pixels), in the order of their addition."""
        return _uncentred(self._vectors[: self._count])

    def tiles_at(self, index: Indices) -> Tiles:
        """Return the tiles of these numbers, shape (m, pixels)."""
        return _uncentred(self._vectors[index])

    def append(self, tiles: Tiles) -> None:
        """Add tiles, shape (m, pixels). The caller respects the capacity."""
        end = self._count + tiles.shape[0]
        self._grow(end)
        part = slice(self._count, end)
        self._vectors[part] = _centred(tiles)
        self._norms[part] = squared_norms(self._vectors[part])
        fill_columns(self._columns, self._count, self._vectors[part], self._norms[part])
        self._count = end

    def nearest(self, tiles: Tiles) -> tuple[Indices, Distances]:
        """Return number and squared distance of the nearest stored tile (the lowest of equals) for each of `tiles`."""
        used = slice(self._count)
        columns = self._columns[:, : -(-self._count // GROUP) * GROUP]
        search = NearestSearch(columns, self._vectors[used], self._norms[used])
        index = np.empty(tiles.shape[0], dtype=np.int64)
        squared = np.empty(tiles.shape[0])
        for start in range(0, tiles.shape[0], _QUERY_ROWS):
            part = slice(start, start + _QUERY_ROWS)
            queries = _centred(tiles[part]).astype(np.float64)
            found, distances = search.nearest(queries, 1)
            index[part], squared[part] = found[:, 0], distances[:, 0]
        return index, squared

    def add_far(self, tiles: Tiles, squared_distance: Distances, min_distance: float) -> Tiles:
        """Add, in order, each tile farther than `min_distance` from all stored tiles, including those just added.

        Args:
            tiles: Shape (m, pixels).
            squared_distance: Shape (m,): squared distance of each tile to its nearest stored tile.
            min_distance: Distance that must be exceeded. 0 rejects only exact duplicates.

        Returns:
            The added tiles, shape (0..m, pixels).
        """
        far = np.flatnonzero(squared_distance > min_distance * min_distance)
        free = self.capacity - self._count
        chosen: list[int] = []
        for start in range(0, far.size, _CHUNK_TILES):
            chunk = far[start : start + _CHUNK_TILES]
            least = squared_distance[chunk]
            for first in range(0, len(chosen), _POOL_TILES):
                pool = tiles[chosen[first : first + _POOL_TILES]]
                np.minimum(least, _squared_distances(tiles[chunk], pool).min(axis=1), out=least)
            between = _squared_distances(tiles[chunk], tiles[chunk])
            for position in range(chunk.size):
                if least[position] > min_distance * min_distance and len(chosen) < free:
                    chosen.append(int(chunk[position]))
                    np.minimum(least, between[position], out=least)
            if len(chosen) == free:
                break
        added = np.ascontiguousarray(tiles[chosen])
        self.append(added)
        return added

    def _grow(self, count: int) -> None:
        allocated = self._vectors.shape[0]
        if count <= allocated:
            return
        allocated = min(max(count, 2 * allocated), max(self.capacity, count))
        for name in ("_vectors", "_norms"):
            old = getattr(self, name)
            larger = np.zeros((allocated, *old.shape[1:]), dtype=old.dtype)
            larger[: self._count] = old[: self._count]
            setattr(self, name, larger)
        columns = empty_columns(allocated, self._vectors.shape[1])
        columns[:, : self._columns.shape[1]] = self._columns
        self._columns = columns


def _centred(tiles: Tiles) -> npt.NDArray[np.int8]:
    return (tiles ^ np.uint8(_CENTRE)).view(np.int8)  # subtracts 128 in one byte


def _uncentred(vectors: npt.NDArray[np.int8]) -> Tiles:
    return vectors.view(np.uint8) ^ np.uint8(_CENTRE)


def _squared_distances(tiles_a: Tiles, tiles_b: Tiles) -> Distances:
    """Return exact squared distances, shape (m, n)."""
    a, b = _centred(tiles_a), _centred(tiles_b)
    products = (a.astype(np.float32) @ b.astype(np.float32).T).astype(np.float64)
    return np.asarray(squared_norms(a)[:, None] + squared_norms(b) - 2.0 * products, dtype=np.float64)
