"""The tile database both ends of the link share, and the search for the tile most like a piece of a picture.

Tiles are compared after projection on a principal-component basis, as the paper does (70 dimensions kept). The basis
cannot see a tile's finest grain, and a grainy tile would be chosen where a smooth one is nearer; so the few tiles
nearest in the basis are compared once more in all pixels (with 20 x 20 tiles this gains 0.1 to 0.2 dB).

Mean and basis are held as **integers** (the basis in units of 1/4096), so projections and squared distances are
integers that float64 holds exactly: they are the same, and so are the indices, whatever the processor or the
linear-algebra library. A stream encoded on one machine is byte for byte the stream of any other.

The search is exact, yet most of its work is one matrix product in single precision: its result is only used to leave
out tiles that cannot be among the nearest, by more than its rounding error can be (`NearestSearch`); the few that
remain are compared in integers. The product itself is spared for tiles whose first coordinate alone is too far away.
"""

from __future__ import annotations

import hashlib
import importlib
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import ParamSpec, cast

import numpy as np
import numpy.typing as npt

from sonarpost.errors import CatalogueError

MIN_TILE_PX = 4
MAX_TILE_PX = 32  # a squared distance of 32 x 32 tiles in units of (1/4096)^2 still fits float64's 53 bits
MAX_DIMS = 70
BASIS_SCALE = 4096

SHORTLIST = 8
"""Tiles nearest in the basis that are compared in all pixels; 32 or 128 give the same pictures, measured."""

BLOCK_TILES = 2048  # tiles of one matrix product: its result stays in a processor's cache
_LEADING = 48  # coordinates of a tile that count singly in the first, rough comparison
_GLANCE_TILES = 128  # tiles of like key that tell how far to search
_LANES = 32  # scores that are compared at once
_QUERY_ROWS = 256
_FAR = np.float32(1e30)  # score of a place that holds no tile; squared norms stay below 2e15
_NO_LIMIT = 1e29

P = ParamSpec("P")
Tiles = npt.NDArray[np.uint8]
Basis = npt.NDArray[np.int16]
Indices = npt.NDArray[np.int64]
Distances = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TileDatabase:
    """A fixed list of tiles with the space they are compared in.

    Attributes:
        tile_px: Side of the square tiles, 4..32 px.
        tiles: Shape (n, tile_px * tile_px), uint8, each row one tile in raster order; n is at least 1.
        mean: Shape (tile_px * tile_px,), uint8, subtracted before projection.
        basis: Shape (dims, tile_px * tile_px), int16, rows are unit vectors times 4096; 1..70 dims.
        projections: Shape (n, dims), float64 holding integers: `(tiles - mean) @ basis.T`.

    Raises:
        CatalogueError: A shape, dtype or count is not as above.
    """

    tile_px: int
    tiles: Tiles
    mean: Tiles
    basis: Basis
    projections: npt.NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        pixels = self.tile_px * self.tile_px
        _check("tile_px", self.tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX}", MIN_TILE_PX <= self.tile_px <= MAX_TILE_PX)
        _check_array("tiles", self.tiles, np.dtype(np.uint8), (max(1, self.tiles.shape[0]), pixels))
        _check_array("mean", self.mean, np.dtype(np.uint8), (pixels,))
        dims = min(max(1, self.basis.shape[0]), MAX_DIMS, pixels)
        _check_array("basis", self.basis, np.dtype(np.int16), (dims, pixels))
        for name in ("tiles", "mean", "basis"):
            # A private, read-only copy: the identity below must stay true for as long as the object lives.
            array = np.array(getattr(self, name), order="C")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        projections = self.project(self.tiles)
        projections.setflags(write=False)
        object.__setattr__(self, "projections", projections)

    @classmethod
    def from_tiles(cls, tile_px: int, tiles: Tiles, dims: int = MAX_DIMS) -> TileDatabase:
        """Make a database whose basis is the principal components of its own tiles.

        Args:
            tile_px: Side of a tile in pixels.
            tiles: Shape (n, tile_px * tile_px), uint8.
            dims: Dimensions to keep, 1..70; fewer are kept where the tiles span fewer.

        Raises:
            CatalogueError: Shapes or counts outside the documented ranges.
        """
        _check("dims", dims, f"1..{MAX_DIMS}", 1 <= dims <= MAX_DIMS)
        _check("tile_px", tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX}", MIN_TILE_PX <= tile_px <= MAX_TILE_PX)
        _check_array("tiles", tiles, np.dtype(np.uint8), (max(1, tiles.shape[0]), tile_px * tile_px))
        mean, basis = principal_basis(tiles, dims)
        return cls(tile_px, tiles, mean, basis)

    def __len__(self) -> int:
        return int(self.tiles.shape[0])

    @property
    def dims(self) -> int:
        """Dimensions of the space tiles are compared in."""
        return int(self.basis.shape[0])

    @cached_property
    def identity(self) -> str:
        """Hex sha256 over everything that decides a picture or an index (see docs/catalogue.md)."""
        digest = hashlib.sha256(b"sonarpost tile database 1\n")
        digest.update(struct.pack(">HIH", self.tile_px, len(self), self.dims))
        digest.update(self.tiles.tobytes())
        digest.update(self.mean.tobytes())
        digest.update(self.basis.astype(">i2").tobytes())
        return digest.hexdigest()

    def project(self, tiles: Tiles) -> npt.NDArray[np.float64]:
        """Return the coordinates of tiles, shape (m, dims), float64 holding integers (1/4096 grey level).

        Args:
            tiles: Shape (m, tile_px * tile_px), uint8.
        """
        centred = tiles.astype(np.float64) - self.mean.astype(np.float64)
        return np.asarray(centred @ self.basis.T.astype(np.float64), dtype=np.float64)

    def nearest(self, tiles: Tiles) -> tuple[Indices, Distances]:
        """Find, for each of `tiles`, the nearest in all pixels among the `SHORTLIST` nearest in the basis.

        Args:
            tiles: Shape (m, tile_px * tile_px), uint8.

        Returns:
            Indices, shape (m,), int64 (the lowest of equally near ones); Euclidean distances over all pixels, shape
            (m,), float64, grey levels.
        """
        shortlist, _ = self.nearest_in_basis(tiles, SHORTLIST)
        shortlist = np.sort(shortlist, axis=1)  # so that the first of equals is the lowest index
        squared = np.empty(shortlist.shape, dtype=np.int32)  # 32 x 32 px differ by at most 1024 * 255^2 < 2^27
        wide = tiles.astype(np.int32)
        for rank in range(shortlist.shape[1]):
            difference = self.tiles[shortlist[:, rank]] - wide
            squared[:, rank] = np.einsum("ij,ij->i", difference, difference)
        rows = np.arange(tiles.shape[0])
        best = np.argmin(squared, axis=1)
        return shortlist[rows, best], np.sqrt(squared[rows, best].astype(np.float64))

    def nearest_in_basis(self, tiles: Tiles, count: int = 1) -> tuple[Indices, Distances]:
        """Find, for each of `tiles`, the `count` database tiles of least Euclidean distance in the basis.

        With a count of 1 this is the paper's search. Squared distances are exact (module docstring). Of
        equally near tiles those with lower indices come first.

        Args:
            tiles: Shape (m, tile_px * tile_px), uint8.
            count: How many; at most as many as there are tiles are returned.

        Returns:
            Indices, shape (m, count), int64, nearest first; distances, same shape, float64, grey levels.
        """
        count = min(count, len(self))
        indices = np.empty((tiles.shape[0], count), dtype=np.int64)
        squared = np.empty((tiles.shape[0], count))
        for start in range(0, tiles.shape[0], _QUERY_ROWS):
            rows = slice(start, start + _QUERY_ROWS)
            queries = self.project(tiles[rows])
            indices[rows], squared[rows] = self._search.nearest(queries, queries[:, 0], count)
        return indices, np.sqrt(squared) / BASIS_SCALE

    @cached_property
    def _search(self) -> NearestSearch:
        # 32 x 32 px have coordinates of at most 32 * 255 * 4096 < 2^31.
        vectors = self.projections.astype(np.int32)
        return NearestSearch.over(vectors, self.projections[:, 0], min(self.dims, _LEADING))


@dataclass(frozen=True)
class NearestSearch:
    """Exact search for the nearest among integer vectors, at the speed of single precision.

    A product of matrices in single precision gives a score for each vector b that is no more than its true score
    |b|^2 - 2ab (squared distance less |a|^2), apart from a rounding error of at most `rounding_bound`: the leading
    coordinates count as they are, of the others only the lengths r, since their product is at most r(a) r(b). Only
    vectors whose score is not above the best so far by more than the error are compared in exact integers. A block of
    vectors is spared altogether where its keys alone are too far away from the query's: a key is any function of a
    vector with |key(a) - key(b)| <= |a - b|, such as a coordinate.

    Attributes:
        blocks: Shape (blocks, leading + 2, vectors of a block), float32: in each column a vector's leading
            coordinates, the length of the others, and its squared norm.
        order: Shape (n,), int64: the number of the vector that a place holds.
        vectors: Shape (n, dims), integers, by places.
        norms: Shape (n,), float64: exact squared norms, by places.
        keys: Shape (n,), float64: keys of the places; ascending, or else nothing is spared and the search is slower.
    """

    blocks: npt.NDArray[np.float32]
    order: Indices
    vectors: npt.NDArray[np.signedinteger]
    norms: Distances
    keys: Distances

    @classmethod
    def over(cls, vectors: npt.NDArray[np.signedinteger], keys: Distances, leading: int) -> NearestSearch:
        """Lay out vectors, shape (n, dims), sorted by their keys, shape (n,); see the class for `leading`."""
        count = vectors.shape[0]
        width = min(BLOCK_TILES, -(-count // _LANES) * _LANES)
        order = np.argsort(keys, kind="stable")
        vectors = vectors[order]
        norms = squared_norms(vectors)
        blocks = empty_blocks(-(-count // width), leading, width)
        fill_blocks(blocks, 0, vectors, norms)
        return cls(blocks, order, vectors, norms, keys[order])

    def nearest(self, queries: Distances, keys: Distances, count: int) -> tuple[Indices, Distances]:
        """Return numbers and squared distances, shape (m, count) each, nearest first, of equals the lowest first.

        Args:
            queries: Shape (m, dims), float64, integers.
            keys: Shape (m,), float64, their keys.
            count: How many; no more than there are vectors.
        """
        found = _Found(self, queries, count)
        found.look_around(np.searchsorted(self.keys, keys))
        width = self.blocks.shape[2]
        for block, (least, largest) in enumerate(self._key_ranges):
            reach = np.sqrt(np.maximum(found.limit + found.own, 0.0)) * (1 + 1e-9)
            rows = np.flatnonzero((least <= keys + reach) & (largest >= keys - reach))
            if rows.size:
                scores = found.singles[rows] @ self.blocks[block]
                found.take(scores, rows, np.full(rows.size, block * width))
        return found.index, found.value + found.own[:, None]

    @cached_property
    def _key_ranges(self) -> list[tuple[float, float]]:
        width = self.blocks.shape[2]
        parts = [self.keys[start : start + width] for start in range(0, self.keys.size, width)]
        return [(float(part.min()), float(part.max())) for part in parts]


class _Found:
    """The nearest vectors found so far for each of some queries.

    Attributes:
        index: Shape (queries, count), int64: their numbers.
        value: Shape (queries, count), float64: their exact scores, ascending; infinite where none is found yet.
        limit: Shape (queries,), float64: a vector with a single-precision score above this is not among the nearest.
        own: Shape (queries,), float64: |a|^2.
        singles: Shape (queries, leading + 2), float32: rows whose product with a column of the blocks is its score.
    """

    def __init__(self, search: NearestSearch, queries: Distances, count: int) -> None:
        self._search = search
        self._queries = queries
        self.index = np.full((queries.shape[0], count), -1, dtype=np.int64)
        self.value = np.full((queries.shape[0], count), np.inf)
        self.limit = np.full(queries.shape[0], _NO_LIMIT)
        self.own = squared_norms(queries)
        leading = search.blocks.shape[1] - 2
        self.singles = np.ones((queries.shape[0], leading + 2), dtype=np.float32)
        self.singles[:, :-2] = queries[:, :leading]
        self.singles[:, -2] = np.sqrt(squared_norms(queries[:, leading:]))
        self.singles[:, :-1] *= -2.0
        largest = float(np.sqrt(search.norms.max()))
        self._slack = rounding_bound(np.sqrt(self.own), largest, leading + 1)

    def look_around(self, places: Indices) -> None:
        """Compare each query with some vectors around a place, which tells how far there is to search."""
        width = self._search.blocks.shape[2]
        length = min(_GLANCE_TILES, width)
        block, column = np.divmod(np.minimum(places, self._search.keys.size - 1), width)
        column = np.clip(column - length // 2, 0, width - length)
        scores = np.empty((places.size, length), dtype=np.float32)
        _compiled(_score_around)(self._search.blocks, self.singles, block, column, scores)
        self.take(scores, np.arange(places.size), block * width + column)

    def take(self, scores: npt.NDArray[np.float32], rows: Indices, firsts: Indices) -> None:
        """Take what is near.

        Args:
            scores: Shape (m, n), n a multiple of 32: of a query and consecutive places each.
            rows: Shape (m,): the queries.
            firsts: Shape (m,): the first of the places.
        """
        search = self._search
        exact = (search.order, self._queries, search.vectors, search.norms, self._slack)
        _compiled(_take)(scores, rows, firsts, *exact, self.index, self.value, self.limit)


def _score_around(
    blocks: npt.NDArray[np.float32],
    singles: npt.NDArray[np.float32],
    block: Indices,
    column: Indices,
    scores: npt.NDArray[np.float32],
) -> None:
    """Score each query against the columns from `column` on in its block, as many as `scores` is wide."""
    for query in range(singles.shape[0]):
        own = scores[query]
        own[:] = 0.0
        for row in range(singles.shape[1]):
            factor = singles[query, row]
            values = blocks[block[query], row, column[query] : column[query] + own.size]
            for lane in range(own.size):
                own[lane] += factor * values[lane]


def _take(
    scores: npt.NDArray[np.float32],
    rows: Indices,
    firsts: Indices,
    order: Indices,
    queries: Distances,
    vectors: npt.NDArray[np.signedinteger],
    norms: Distances,
    slack: Distances,
    index: Indices,
    value: Distances,
    limit: Distances,
) -> None:
    """Insert the vectors that belong into the sorted `index` and `value` of their query; see `_Found.take`."""
    last = value.shape[1] - 1
    for i in range(rows.size):
        query = rows[i]
        bound = np.float32(limit[query])
        for start in range(0, scores.shape[1], _LANES):
            own = scores[i, start : start + _LANES]
            least = own[0]
            for lane in range(_LANES):
                least = min(least, own[lane])
            if least > bound:
                continue
            for lane in range(_LANES):
                if own[lane] > bound:
                    continue
                place = firsts[i] + start + lane
                number = order[place]
                product = 0.0
                for axis in range(queries.shape[1]):
                    product += queries[query, axis] * vectors[place, axis]
                exact = norms[place] - 2.0 * product
                rank = last + 1
                while rank > 0 and (
                    exact < value[query, rank - 1]
                    or (exact == value[query, rank - 1] and number < index[query, rank - 1])
                ):
                    rank -= 1
                if rank > last or (rank > 0 and index[query, rank - 1] == number):
                    continue
                for later in range(last, rank, -1):
                    index[query, later], value[query, later] = index[query, later - 1], value[query, later - 1]
                index[query, rank], value[query, rank] = number, exact
                limit[query] = min(value[query, last] + slack[query], _NO_LIMIT)
                bound = np.float32(limit[query])


@cache
def _compiled(function: Callable[P, None]) -> Callable[P, None]:
    """Compile on first use: importing the compiler takes longer than most commands.

    Sums may be reassociated: those of integers are exact anyhow, and `rounding_bound` is for any order.
    """
    numba = importlib.import_module("numba")
    return cast(Callable[P, None], numba.njit(cache=True, fastmath={"reassoc", "contract", "nnan", "nsz"})(function))


def squared_norms(vectors: npt.NDArray[np.generic]) -> Distances:
    """Return the exact squared norms of integer vectors, shape (n, dims), as float64, shape (n,)."""
    wide = vectors.astype(np.float64)
    return np.asarray(np.einsum("ij,ij->i", wide, wide), dtype=np.float64)


def empty_blocks(number: int, leading: int, width: int = BLOCK_TILES) -> npt.NDArray[np.float32]:
    """Return blocks as `NearestSearch` holds them, in which every place is empty."""
    blocks = np.zeros((number, leading + 2, width), dtype=np.float32)
    blocks[:, -1] = _FAR
    return blocks


def fill_blocks(
    blocks: npt.NDArray[np.float32], start: int, vectors: npt.NDArray[np.signedinteger], norms: Distances
) -> None:
    """Put vectors, shape (m, dims), and their squared norms, shape (m,), into the places from `start` on."""
    block, column = np.divmod(np.arange(start, start + vectors.shape[0]), blocks.shape[2])
    leading = blocks.shape[1] - 2
    blocks[block, :-2, column] = vectors[:, :leading]
    blocks[block, -2, column] = np.sqrt(squared_norms(vectors[:, leading:]))
    blocks[block, -1, column] = norms


def rounding_bound(norms: Distances, largest: float, dims: int) -> Distances:
    """Return how far |b|^2 - 2ab in single precision may be from the truth, whatever the order of summation.

    Each of dims + 1 products has two rounded factors and is rounded, and takes part in at most dims additions: a
    relative error of (dims + 3) units of 2^-24 to first order (Higham, "Accuracy and Stability of Numerical
    Algorithms", 2nd ed., section 3.1), and the sum of the magnitudes is at most 2 |a| |b| + |b|^2. The factor 1.01
    covers the rest.

    Args:
        norms: Shape (m,), |a|.
        largest: The largest |b|.
        dims: Length of the vectors.
    """
    return np.asarray(1.01 * (dims + 4) * 2.0**-24 * (2.0 * norms * largest + largest * largest), dtype=np.float64)


def principal_basis(tiles: Tiles, dims: int) -> tuple[Tiles, Basis]:
    """Return the rounded mean and the leading principal components of `tiles`, in integers.

    Sums and products of pixels are exact integers; only the eigenvectors of the covariance are floating point, and
    they are rounded to 1/4096. The sign of each is fixed: its entry of largest magnitude (the first of equals) is
    positive. Components that carry no variance are left out, but at least one is kept.

    Args:
        tiles: Shape (n, pixels), uint8, n at least 1.
        dims: Most components to keep.

    Returns:
        Mean, shape (pixels,), uint8; basis, shape (1..dims, pixels), int16.
    """
    count = tiles.shape[0]
    values = tiles.astype(np.float64)
    total = values.sum(axis=0)
    covariance = (values.T @ values) / count - np.outer(total, total) / (count * count)
    variances, vectors = np.linalg.eigh(covariance)
    order = np.argsort(-variances, kind="stable")[:dims]
    kept = max(1, int(np.count_nonzero(variances[order] > 1e-9 * max(float(variances.max()), 1.0))))
    basis = vectors[:, order[:kept]].T
    peaks = np.argmax(np.abs(np.round(basis * BASIS_SCALE)), axis=1)
    signs = np.sign(basis[np.arange(kept), peaks])
    mean = np.floor(total / count + 0.5).astype(np.uint8)
    return mean, np.round(basis * signs[:, None] * BASIS_SCALE).astype(np.int16)


def cut_tiles(image: npt.NDArray[np.uint8], tile_px: int) -> Tiles:
    """Cut an image into tiles that cover all of it; edge tiles are filled by repeating the last row and column.

    Args:
        image: Shape (height, width), uint8.
        tile_px: Side of a tile in pixels.

    Returns:
        Shape (ceil(height / tile_px) * ceil(width / tile_px), tile_px * tile_px), uint8, tiles in raster order.
    """
    rows, columns = tile_grid(image.shape[0], image.shape[1], tile_px)
    below, right = rows * tile_px - image.shape[0], columns * tile_px - image.shape[1]
    padded = np.pad(image, ((0, below), (0, right)), mode="edge")
    blocks = padded.reshape(rows, tile_px, columns, tile_px).swapaxes(1, 2)
    return np.ascontiguousarray(blocks.reshape(rows * columns, tile_px * tile_px))


def join_tiles(tiles: Tiles, height_px: int, width_px: int, tile_px: int) -> npt.NDArray[np.uint8]:
    """Put tiles back together and crop to the picture: the inverse of `cut_tiles`.

    Returns:
        Shape (height_px, width_px), uint8.
    """
    rows, columns = tile_grid(height_px, width_px, tile_px)
    blocks = tiles.reshape(rows, columns, tile_px, tile_px).swapaxes(1, 2)
    return np.ascontiguousarray(blocks.reshape(rows * tile_px, columns * tile_px)[:height_px, :width_px])


def tile_grid(height_px: int, width_px: int, tile_px: int) -> tuple[int, int]:
    """Return rows and columns of tiles that cover a picture."""
    return -(-height_px // tile_px), -(-width_px // tile_px)


def _check(name: str, value: object, expected: str, good: bool) -> None:  # noqa: FBT001 - a condition, not a switch
    if not good:
        raise CatalogueError("tile database", name, value, expected)


def _check_array(
    name: str, array: npt.NDArray[np.generic], dtype: np.dtype[np.generic], shape: tuple[int, ...]
) -> None:
    _check(f"{name}.dtype", str(array.dtype), str(dtype), array.dtype == dtype)
    _check(f"{name}.shape", array.shape, str(shape), array.shape == shape)
