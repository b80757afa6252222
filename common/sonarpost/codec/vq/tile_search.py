"""Exact nearest-neighbour search among tiles; most of its work is a matrix product in single precision.

The product only excludes vectors that cannot be among the nearest, with a margin for its rounding error. The remaining
vectors are compared in exact integers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

GROUP = 32  # scores of which only the least is sorted
_PAIRS = 65_536  # compared exactly at a time, to limit the memory if many vectors are equal
_EMPTY = np.float32(1e30)  # squared norm of an empty place; others stay below 2e15

Indices = npt.NDArray[np.int64]
Distances = npt.NDArray[np.float64]
FloatMatrix = npt.NDArray[np.float32]
Vectors = npt.NDArray[np.signedinteger] | Distances
"""Vectors of integers, of any type that holds them exactly."""


@dataclass(frozen=True)
class NearestSearch:
    """Exact nearest-neighbour search among integer vectors.

    The score of a vector b for a query a is |b|^2 - 2ab, the squared distance minus |a|^2. A single-precision matrix
    product gives all scores, up to a rounding error of `rounding_bound`. Only vectors whose score does not exceed the
    best ones by more than this error are compared exactly.

    Attributes:
        columns: Shape (dims + 1, places), float32, see `empty_columns` and `fill_columns`.
        vectors: Shape (n, dims).
        norms: Shape (n,): exact squared norms.
    """

    columns: FloatMatrix
    vectors: Vectors
    norms: Distances

    @classmethod
    def over(cls, vectors: Vectors) -> NearestSearch:
        """Build a search over vectors, shape (n, dims)."""
        norms = squared_norms(vectors)
        columns = empty_columns(len(vectors), vectors.shape[1])
        fill_columns(columns, 0, vectors, norms)
        return cls(columns, vectors, norms)

    def nearest(self, queries: Distances, count: int) -> tuple[Indices, Distances]:
        """Find the nearest vectors of each query.

        Args:
            queries: Shape (m, dims), float64 holding integers.
            count: Number of vectors to find, at most n.

        Returns:
            Vector numbers and squared distances, shape (m, count) each, nearest first, the lowest number first among
            equally near ones.
        """
        query_norms = squared_norms(queries)
        rows = np.ones((len(queries), queries.shape[1] + 1), dtype=np.float32)
        rows[:, :-1] = -2.0 * queries
        scores = rows @ self.columns
        groups = scores.shape[1] // GROUP
        least = scores.reshape(len(queries), GROUP, groups).min(axis=1)
        bounds = np.partition(least if count <= groups else scores, count - 1, axis=1)[:, count - 1].astype(np.float64)
        margin = 2.0 * rounding_bound(np.sqrt(query_norms), float(np.sqrt(self.norms.max())), queries.shape[1])
        limits = np.nextafter((bounds + margin).astype(np.float32), np.float32(np.inf))
        query, group = np.nonzero(least <= limits[:, None])
        query, number = np.repeat(query, GROUP), (group[:, None] + groups * np.arange(GROUP)).ravel()
        is_near = scores[query, number] <= limits[query]
        query, number = query[is_near], number[is_near]
        exact = self.norms[number]
        for start in range(0, len(exact), _PAIRS):
            part = slice(start, start + _PAIRS)
            near = self.vectors[number[part]].astype(np.float64)
            exact[part] -= 2.0 * np.einsum("ij,ij->i", queries[query[part]], near)
        order = np.lexsort((number, exact, query))
        first = np.searchsorted(query[order], np.arange(len(queries)))
        chosen = order[first[:, None] + np.arange(count)]
        return number[chosen], exact[chosen] + query_norms[:, None]


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


def empty_columns(count: int, dims: int) -> FloatMatrix:
    """Return the columns of a search with `count` empty places, rounded up to whole groups."""
    columns = np.zeros((dims + 1, -(-count // GROUP) * GROUP), dtype=np.float32)
    columns[-1] = _EMPTY
    return columns


def fill_columns(columns: FloatMatrix, start: int, vectors: Vectors, norms: Distances) -> None:
    """Write vectors, shape (m, dims), and their squared norms to the places from `start`."""
    columns[:-1, start : start + len(vectors)] = vectors.T
    columns[-1, start : start + len(vectors)] = norms
