"""The exact tile search, compared with distances in Python integers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from research.codebook.basis import database_of
from sonarpost.codec.vq.codebook import load_default
from sonarpost.codec.vq.tile_search import NearestSearch


def brute_force(vectors: np.ndarray, queries: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    difference = queries[:, None].astype(np.int64) - vectors[None].astype(np.int64)
    squared = (difference * difference).sum(axis=2)
    index = np.argsort(squared, axis=1, kind="stable")[:, :count]
    return index, np.take_along_axis(squared, index, axis=1)


def check(vectors: np.ndarray, queries: np.ndarray, count: int) -> None:
    index, squared = NearestSearch.over(vectors).nearest(queries.astype(np.float64), count)
    expected_index, expected_squared = brute_force(vectors, queries, count)
    assert np.array_equal(squared, expected_squared)
    assert np.array_equal(index, expected_index)


@given(
    seed=st.integers(0, 2**32 - 1),
    vectors=st.integers(1, 300),
    queries=st.integers(1, 9),
    dims=st.integers(1, 7),
    largest=st.sampled_from([0, 1, 3, 100, 8_000_000]),
    count=st.integers(1, 12),
)
def test_search_is_exact_with_ties_and_duplicates(seed, vectors, queries, dims, largest, count):
    rng = np.random.default_rng(seed)
    stored = rng.integers(-largest, largest + 1, (vectors, dims), dtype=np.int32)
    query_vectors = rng.integers(-largest, largest + 1, (queries, dims), dtype=np.int32)
    query_vectors[::2] = stored[rng.integers(0, vectors, query_vectors[::2].shape[0])]
    check(stored, query_vectors, min(count, vectors))


@pytest.mark.parametrize(("size", "count"), [(2047, 8), (2048, 1), (2049, 200), (5000, 8)])
def test_search_is_exact_across_groups(size: int, count: int) -> None:
    rng = np.random.default_rng(size)
    stored = (rng.standard_normal((size, 20)) * np.geomspace(3e6, 1e4, 20)).astype(np.int32)
    stored[size // 2 :: 7] = stored[0]  # duplicates, distributed over the groups
    queries = (rng.standard_normal((20, 20)) * np.geomspace(4e6, 1e4, 20)).astype(np.int32)
    queries[0] = stored[0]
    check(stored, queries, count)


def test_distances_closer_than_single_precision_are_distinguished() -> None:
    # Around 8e6 the squares are near 6e13, where single precision has steps of 4 million.
    rng = np.random.default_rng(0)
    stored = (8_000_000 + rng.integers(-3, 4, (3000, 30))).astype(np.int32)
    check(stored, stored[:50] + 1, 8)


def test_many_equal_vectors_are_compared_in_parts() -> None:
    check(np.zeros((20_000, 3), np.int32), np.zeros((5, 3), np.int32), 8)


def test_search_in_the_shipped_codebook_is_exact() -> None:
    database = load_default(10).tiles
    rng = np.random.default_rng(2)
    noise = np.clip(60 * rng.rayleigh(1.0, (12, 100)), 0, 255).astype(np.uint8)
    flat = np.repeat(np.arange(0, 256, 51, dtype=np.uint8)[:, None], 100, axis=1)
    queries = np.concatenate((noise, flat, database.tiles[::3000]))
    index, distance = database.nearest_in_basis(queries, 8)
    expected, squared = brute_force(database.projections, database.project(queries), 8)
    assert np.array_equal(index, expected)
    assert np.allclose(distance, np.sqrt(squared) / 4096, rtol=1e-12)


def test_search_without_queries_and_with_few_tiles() -> None:
    database = database_of(4, np.arange(32, dtype=np.uint8).reshape(2, 16))
    index, distance = database.nearest_in_basis(np.zeros((0, 16), np.uint8), 8)
    assert index.shape == distance.shape == (0, 2)
    index, _ = database.nearest_in_basis(database.tiles, 8)
    assert index.tolist() == [[0, 1], [1, 0]]
