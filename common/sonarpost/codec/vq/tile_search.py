"""Exact nearest-neighbour search among tiles; most of its work is a matrix product in single precision.

The product only excludes vectors that cannot be among the nearest, with a margin for its rounding error. The remaining
vectors are compared in exact integers. The product is skipped for vectors whose first coordinate alone is too far away.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import ParamSpec

import numpy as np
import numpy.typing as npt

from sonarpost.codec.jit import jit

BLOCK_TILES = 2048  # tiles of one matrix product: its result fits a processor cache
LEADING = 48  # leading coordinates of a tile used in the single-precision comparison
_INITIAL_TILES = 128  # tiles around the query's key that give the first upper bound
_LANES = 32  # scores compared at once
_EMPTY = np.float32(1e30)  # score of an empty place; squared norms stay below 2e15
_NO_LIMIT = 1e29

P = ParamSpec("P")
Indices = npt.NDArray[np.int64]
Distances = npt.NDArray[np.float64]
FloatMatrix = npt.NDArray[np.float32]
Vectors = npt.NDArray[np.signedinteger]


@dataclass(frozen=True)
class NearestSearch:
    """Exact nearest-neighbour search among integer vectors.

    The score of a vector b for a query a is |b|^2 - 2ab, the squared distance minus |a|^2. A single-precision matrix
    product gives a lower bound of each score, up to a rounding error of `rounding_bound`. It uses the leading
    coordinates, and of the others only their lengths r: their product is at most r(a) r(b). Only vectors whose lower
    bound does not exceed the best score plus the error are compared exactly.

    A block of vectors is skipped if its keys are too far from the query's key. A key is any function of a vector with
    |key(a) - key(b)| <= |a - b|, for example a coordinate.

    Attributes:
        blocks: Shape (blocks, leading + 2, vectors a block), float32. Each column holds a vector's leading coordinates,
            the length of the others, and the squared norm.
        order: Shape (n,): vector number of each place.
        vectors: Shape (n, dims), integers, by place.
        norms: Shape (n,): exact squared norms, by place.
        keys: Shape (n,): keys, by place. If they are not ascending, no block is skipped.
    """

    blocks: FloatMatrix
    order: Indices
    vectors: Vectors
    norms: Distances
    keys: Distances

    @classmethod
    def over(cls, vectors: Vectors, keys: Distances, leading: int) -> NearestSearch:
        """Build a search over vectors, shape (n, dims), sorted by their keys, shape (n,)."""
        count = vectors.shape[0]
        width = min(BLOCK_TILES, -(-count // _LANES) * _LANES)
        order = np.argsort(keys, kind="stable")
        vectors = vectors[order]
        norms = squared_norms(vectors)
        blocks = empty_blocks(-(-count // width), leading, width)
        fill_blocks(blocks, 0, vectors, norms)
        return cls(blocks, order, vectors, norms, keys[order])

    def nearest(self, queries: Distances, keys: Distances, count: int) -> tuple[Indices, Distances]:
        """Find the nearest vectors of each query.

        Args:
            queries: Shape (m, dims), float64 holding integers.
            keys: Shape (m,): keys of the queries.
            count: Number of vectors to find, at most n.

        Returns:
            Vector numbers and squared distances, shape (m, count) each, nearest first, the lowest number first among
            equally near ones.
        """
        state = _SearchState(self, queries, count)
        state.compare_around(np.searchsorted(self.keys, keys))
        width = self.blocks.shape[2]
        for block, (low, high) in enumerate(self._key_ranges):
            reach = np.sqrt(np.maximum(state.limit + state.query_norms, 0.0)) * (1 + 1e-9)
            rows = np.flatnonzero((low <= keys + reach) & (high >= keys - reach))
            if rows.size:
                scores = state.query_rows[rows] @ self.blocks[block]
                state.compare(scores, rows, np.full(rows.size, block * width))
        return state.index, state.score + state.query_norms[:, None]

    @cached_property
    def _key_ranges(self) -> list[tuple[float, float]]:
        width = self.blocks.shape[2]
        parts = [self.keys[start : start + width] for start in range(0, self.keys.size, width)]
        return [(float(part.min()), float(part.max())) for part in parts]


class _SearchState:
    """The nearest vectors found so far for each query.

    Attributes:
        index: Shape (queries, count): their numbers.
        score: Shape (queries, count): their exact scores, ascending; infinite for places not yet filled.
        limit: Shape (queries,): a vector with a single-precision score above the limit is not among the nearest.
        query_norms: Shape (queries,): |a|^2.
        query_rows: Shape (queries, leading + 2), float32: the product with a column of a block is its score.
    """

    def __init__(self, search: NearestSearch, queries: Distances, count: int) -> None:
        self._search = search
        self._queries = queries
        self.index = np.full((queries.shape[0], count), -1, dtype=np.int64)
        self.score = np.full((queries.shape[0], count), np.inf)
        self.limit = np.full(queries.shape[0], _NO_LIMIT)
        self.query_norms = squared_norms(queries)
        leading = search.blocks.shape[1] - 2
        self.query_rows = np.ones((queries.shape[0], leading + 2), dtype=np.float32)
        self.query_rows[:, :-2] = queries[:, :leading]
        self.query_rows[:, -2] = np.sqrt(squared_norms(queries[:, leading:]))
        self.query_rows[:, :-1] *= -2.0
        largest = float(np.sqrt(search.norms.max()))
        self._rounding = rounding_bound(np.sqrt(self.query_norms), largest, leading + 1)

    def compare_around(self, places: Indices) -> None:
        """Compare each query with the vectors around a place. The result limits the search in the blocks."""
        width = self._search.blocks.shape[2]
        length = min(_INITIAL_TILES, width)
        block, column = np.divmod(np.minimum(places, self._search.keys.size - 1), width)
        column = np.clip(column - length // 2, 0, width - length)
        scores = np.empty((places.size, length), dtype=np.float32)
        _compiled(_score_around)(self._search.blocks, self.query_rows, block, column, scores)
        self.compare(scores, np.arange(places.size), block * width + column)

    def compare(self, scores: FloatMatrix, rows: Indices, first_places: Indices) -> None:
        """Insert the vectors whose scores are within the limit.

        Args:
            scores: Shape (m, n), n a multiple of 32: scores of consecutive places.
            rows: Shape (m,): the queries.
            first_places: Shape (m,): the first place of each row of scores.
        """
        search = self._search
        exact = (search.order, self._queries, search.vectors, search.norms, self._rounding)
        _compiled(_insert_nearest)(scores, rows, first_places, *exact, self.index, self.score, self.limit)


def _score_around(
    blocks: FloatMatrix, query_rows: FloatMatrix, block: Indices, column: Indices, scores: FloatMatrix
) -> None:
    """Score each query against the columns of its block, from `column`, as many as `scores` has columns."""
    for query in range(query_rows.shape[0]):
        own = scores[query]
        own[:] = 0.0
        for row in range(query_rows.shape[1]):
            factor = query_rows[query, row]
            values = blocks[block[query], row, column[query] : column[query] + own.size]
            for lane in range(own.size):
                own[lane] += factor * values[lane]


def _insert_nearest(
    scores: FloatMatrix,
    rows: Indices,
    first_places: Indices,
    order: Indices,
    queries: Distances,
    vectors: Vectors,
    norms: Distances,
    rounding: Distances,
    index: Indices,
    score: Distances,
    limit: Distances,
) -> None:
    """Insert vectors into the sorted `index` and `score` of their query; see `_SearchState.compare`."""
    last = score.shape[1] - 1
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
                place = first_places[i] + start + lane
                number = order[place]
                product = 0.0
                for axis in range(queries.shape[1]):
                    product += queries[query, axis] * vectors[place, axis]
                exact = norms[place] - 2.0 * product
                rank = last + 1
                while rank > 0 and (
                    exact < score[query, rank - 1]
                    or (exact == score[query, rank - 1] and number < index[query, rank - 1])
                ):
                    rank -= 1
                if rank > last or (rank > 0 and index[query, rank - 1] == number):
                    continue
                for later in range(last, rank, -1):
                    index[query, later], score[query, later] = index[query, later - 1], score[query, later - 1]
                index[query, rank], score[query, rank] = number, exact
                limit[query] = min(score[query, last] + rounding[query], _NO_LIMIT)
                bound = np.float32(limit[query])


@cache
def _compiled(function: Callable[P, None]) -> Callable[P, None]:
    """Compile on first use, so that importing this module does not import numba.

    Sums may be reordered: sums of integers are exact in any order, and `rounding_bound` holds for any order.
    """
    return jit(function, reorder_sums=True)


def rounding_bound(norms: Distances, largest: float, dims: int) -> Distances:
    """Return the largest rounding error of |b|^2 - 2ab in single precision, for any order of summation.

    Each of dims + 1 products has two rounded factors, is rounded, and takes part in at most dims additions: a relative
    error of (dims + 3) units of 2^-24 to first order (Higham, "Accuracy and Stability of Numerical Algorithms", 2nd
    ed., section 3.1). The sum of the magnitudes is at most 2 |a| |b| + |b|^2. The factor 1.01 covers the higher orders.

    Args:
        norms: Shape (m,), |a|.
        largest: The largest |b|.
        dims: Length of the vectors.
    """
    return np.asarray(1.01 * (dims + 4) * 2.0**-24 * (2.0 * norms * largest + largest * largest), dtype=np.float64)


def squared_norms(vectors: npt.NDArray[np.generic]) -> Distances:
    """Return the exact squared norms of integer vectors, shape (n, dims)."""
    wide = vectors.astype(np.float64)
    return np.asarray(np.einsum("ij,ij->i", wide, wide), dtype=np.float64)


def empty_blocks(count: int, leading: int, width: int = BLOCK_TILES) -> FloatMatrix:
    """Return blocks of `NearestSearch` with empty places."""
    blocks = np.zeros((count, leading + 2, width), dtype=np.float32)
    blocks[:, -1] = _EMPTY
    return blocks


def fill_blocks(blocks: FloatMatrix, start: int, vectors: Vectors, norms: Distances) -> None:
    """Write vectors, shape (m, dims), and their squared norms to the places from `start`."""
    block, column = np.divmod(np.arange(start, start + vectors.shape[0]), blocks.shape[2])
    leading = blocks.shape[1] - 2
    blocks[block, :-2, column] = vectors[:, :leading]
    blocks[block, -2, column] = np.sqrt(squared_norms(vectors[:, leading:]))
    blocks[block, -1, column] = norms
