"""The exact search for the nearest of many vectors, most of whose work is one matrix product in single precision.

The product's result is only used to leave out vectors that cannot be among the nearest, by more than its rounding error
can be; the few that remain are compared in integers. The product itself is spared for vectors whose first coordinate
alone is too far away.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import ParamSpec, cast

import numpy as np
import numpy.typing as npt

BLOCK_TILES = 2048  # tiles of one matrix product: its result stays in a processor's cache
LEADING = 48  # coordinates of a tile that count singly in the first, rough comparison
_GLANCE_TILES = 128  # tiles of like key that tell how far to search
_LANES = 32  # scores that are compared at once
_FAR = np.float32(1e30)  # score of a place that holds no tile; squared norms stay below 2e15
_NO_LIMIT = 1e29

P = ParamSpec("P")
Indices = npt.NDArray[np.int64]
Distances = npt.NDArray[np.float64]


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
