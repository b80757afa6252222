"""The tile database and its exact nearest search."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from research.codebook.basis import database_of, principal_basis
from sonarpost.codec.vq.tiles import BASIS_SCALE, SHORTLIST, TileDatabase, cut_tiles, join_tiles
from sonarpost.errors import CodebookError


def random_tiles(count: int, tile_px: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, tile_px * tile_px), dtype=np.uint8)


def brute_force(database: TileDatabase, tile: np.ndarray) -> list[tuple[int, int]]:
    """Return squared distance in the basis and index of every tile, nearest first, in Python integers."""
    basis = [[int(value) for value in row] for row in database.basis]
    squares = []
    for index, other in enumerate(database.tiles):
        difference = [int(a) - int(b) for a, b in zip(tile, other, strict=True)]
        projected = (sum(x * y for x, y in zip(row, difference, strict=True)) for row in basis)
        squares.append((sum(value**2 for value in projected), index))
    return sorted(squares)


@pytest.mark.parametrize(("tile_px", "dims"), [(4, 16), (5, 7), (10, 70), (16, 20)])
def test_nearest_in_the_basis_matches_brute_force(tile_px: int, dims: int) -> None:
    database = database_of(tile_px, random_tiles(24, tile_px), dims)
    queries = np.concatenate([random_tiles(2, tile_px, 1), database.tiles[20:21]])
    indices, distances = database.nearest_in_basis(queries, 5)
    first, _ = database.nearest_in_basis(queries)
    for query, found, near in zip(queries, indices, distances, strict=True):
        expected = brute_force(database, query)[:5]
        assert found.tolist() == [index for _, index in expected]
        assert near.tolist() == pytest.approx([square**0.5 / BASIS_SCALE for square, _ in expected], rel=1e-12)
    assert first[:, 0].tolist() == indices[:, 0].tolist()


def test_shortlist_is_compared_in_all_pixels() -> None:
    database = database_of(10, random_tiles(3000, 10), 6)  # a small basis
    queries = random_tiles(20, 10, 1)
    index, distance = database.nearest(queries)
    shortlist, _ = database.nearest_in_basis(queries, SHORTLIST)
    exact = ((database.tiles[shortlist].astype(int) - queries[:, None].astype(int)) ** 2).sum(axis=2)
    assert (index == shortlist[np.arange(20), exact.argmin(axis=1)]).all()
    assert (distance == np.sqrt(exact.min(axis=1))).all()
    assert (index != shortlist[:, 0]).any()


@pytest.mark.system
def test_extreme_tiles_give_exact_integers() -> None:
    # Black and white tiles of the largest size have the largest possible distance.
    tiles = np.stack([np.zeros(1024, np.uint8), np.full(1024, 255, np.uint8)])
    database = database_of(32, tiles)
    assert database.dims == 1
    indices, distances = database.nearest(tiles)
    assert indices.tolist() == [0, 1]
    assert distances.tolist() == [0.0, 0.0]
    middle = np.full((1, 1024), 127, np.uint8)
    index, distance = database.nearest(middle)
    assert index.tolist() == [0]
    assert distance[0] == 127 * 32
    assert np.abs(database.projections).max() ** 2 * 4 < 2**53


@pytest.mark.parametrize("copies", [2, 5000])
def test_lowest_index_of_equal_tiles_is_returned(copies: int) -> None:
    one = random_tiles(2, 4)
    tiles = np.concatenate([one[:1], np.repeat(one[1:], copies, axis=0)])
    index, distance = database_of(4, tiles).nearest(one)
    assert index.tolist() == [0, 1]
    assert distance.tolist() == [0.0, 0.0]


def test_basis_rows_are_orthonormal_signed_and_ordered_by_variance() -> None:
    tiles = random_tiles(500, 6)
    tiles[:, :6] = tiles[:, :1]  # six equal pixels: one strong component
    mean, basis = principal_basis(tiles, 20)
    assert mean.tolist() == np.floor(tiles.mean(axis=0) + 0.5).astype(int).tolist()
    rows = basis.astype(float) / BASIS_SCALE
    assert np.abs(rows @ rows.T - np.eye(20)).max() < 2e-3
    assert all(row[np.argmax(np.abs(row))] > 0 for row in rows)
    variances = ((tiles - tiles.mean(axis=0)) @ rows.T).var(axis=0)
    assert (np.diff(variances) < variances[:-1] * 1e-2).all()
    assert np.abs(rows[0, :6]).sum() > np.abs(rows[0, 6:]).sum()


@pytest.mark.parametrize("tiles", [np.zeros((1, 16), np.uint8), np.full((9, 16), 200, np.uint8)])
def test_tiles_without_variance_give_a_database(tiles: np.ndarray) -> None:
    database = database_of(4, tiles)
    assert database.dims == 1
    assert database.nearest(random_tiles(4, 4))[0].tolist() == [0, 0, 0, 0]


def test_identity_depends_on_all_data() -> None:
    tiles = random_tiles(40, 4)
    base = database_of(4, tiles, 8)
    altered, mean, basis = tiles.copy(), base.mean.copy(), base.basis.copy()
    altered[3, 5] ^= 1
    mean[0] ^= 1
    basis[2, 2] += 1
    others = [
        TileDatabase(4, altered, base.mean, base.basis),
        TileDatabase(4, tiles[::-1], base.mean, base.basis),
        TileDatabase(4, tiles[:-1], base.mean, base.basis),
        TileDatabase(4, tiles, mean, base.basis),
        TileDatabase(4, tiles, base.mean, basis),
        TileDatabase(4, tiles, base.mean, base.basis[:-1]),
    ]
    assert len({database.identity for database in [base, *others]}) == 7
    assert TileDatabase(4, tiles.copy(), base.mean, base.basis).identity == base.identity
    assert len(base.identity) == 64


def test_database_is_immutable() -> None:
    tiles = random_tiles(10, 4)
    database = database_of(4, tiles)
    before = database.identity
    tiles[:] = 0
    with pytest.raises(ValueError, match="read-only"):
        database.tiles[0, 0] = 1
    assert TileDatabase(4, database.tiles, database.mean, database.basis).identity == before


@pytest.mark.parametrize(
    ("field", "make"),
    [
        ("tile_px", lambda t: database_of(3, t[:, :9])),
        ("tile_px", lambda t: database_of(33, np.zeros((1, 33 * 33), np.uint8))),
        ("tiles", lambda t: database_of(5, t)),
        ("tiles", lambda t: database_of(4, t[:0])),
        ("tiles", lambda t: database_of(4, t.astype(np.int16))),
        ("tiles.shape", lambda t: TileDatabase(5, t, t[0], np.ones((2, 16), np.int16))),
        ("tiles.shape", lambda t: TileDatabase(4, t[:0], t[0], np.ones((2, 16), np.int16))),
        ("tiles.dtype", lambda t: TileDatabase(4, t.astype(np.int16), t[0], np.ones((2, 16), np.int16))),
        ("dims", lambda t: database_of(4, t, 71)),
        ("dims", lambda t: database_of(4, t, 0)),
        ("mean.shape", lambda t: TileDatabase(4, t, t[0, :5], np.ones((2, 16), np.int16))),
        ("basis.dtype", lambda t: TileDatabase(4, t, t[0], np.ones((2, 16)))),
        ("basis.shape", lambda t: TileDatabase(4, t, t[0], np.ones((17, 16), np.int16))),
        ("basis.shape", lambda t: TileDatabase(4, t, t[0], np.ones((0, 16), np.int16))),
    ],
)
def test_error_names_an_array_of_wrong_shape_or_dtype(field: str, make) -> None:
    with pytest.raises(CodebookError) as caught:
        make(random_tiles(6, 4))
    assert caught.value.field == field


@given(image=hnp.arrays(np.uint8, st.tuples(st.integers(1, 50), st.integers(1, 50))), tile_px=st.integers(4, 32))
def test_join_inverts_cut(image: np.ndarray, tile_px: int) -> None:
    tiles = cut_tiles(image, tile_px)
    assert np.array_equal(join_tiles(tiles, *image.shape, tile_px), image)


def test_tiles_are_in_raster_order_with_repeated_edges() -> None:
    image = np.arange(30, dtype=np.uint8).reshape(5, 6)
    tiles = cut_tiles(image, 4)
    assert tiles.shape == (4, 16)
    assert tiles[0, :4].tolist() == [0, 1, 2, 3]
    assert tiles[1, :4].tolist() == [4, 5, 5, 5]
    assert tiles[2].reshape(4, 4).tolist() == [[24, 25, 26, 27]] * 4
    assert tiles[3].reshape(4, 4).tolist() == [[28, 29, 29, 29]] * 4
