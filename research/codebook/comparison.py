"""Differences of two codebooks: tiles that only one has, distances of the others, and angles of the bases."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from research.codebook.tile_set import IncrementalTileSet
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError


@dataclass(frozen=True)
class UnmatchedTiles:
    """One codebook compared with the other.

    Attributes:
        tiles: Number of tiles, duplicates counted once.
        only_here: Number of tiles that the other codebook does not have.
        rms_median: Median distance of a tile from the nearest of the other codebook, grey levels RMS.
        rms_95: 95th percentile of these distances.
        rms_max: Largest of these distances.
        variance_own: Fraction of the variance of its tiles within its own basis, 0..1.
        variance_other: Fraction within the other codebook's basis.
    """

    tiles: int
    only_here: int
    rms_median: float
    rms_95: float
    rms_max: float
    variance_own: float
    variance_other: float


@dataclass(frozen=True)
class CodebookDifference:
    """Differences of two codebooks of the same tile size.

    Attributes:
        same_identity: Whether a stream of one can be decoded with the other.
        same_numbers: Tile numbers with the same tile in both.
        common: Tiles in both, regardless of their numbers.
        first: The first compared with the second.
        second: The second compared with the first.
        angle_max_deg: Largest principal angle between the spaces of the bases.
        angle_rms_deg: Root mean square of all principal angles.
    """

    same_identity: bool
    same_numbers: int
    common: int
    first: UnmatchedTiles
    second: UnmatchedTiles
    angle_max_deg: float
    angle_rms_deg: float


def compare(first: TileDatabase, second: TileDatabase) -> CodebookDifference:
    """Compare two codebooks.

    Raises:
        CodebookError: The tile sizes differ.
    """
    if first.tile_px != second.tile_px:
        expected = f"{first.tile_px} px as in the first: tiles of different sizes cannot be compared"
        raise CodebookError("second codebook", "tile_px", second.tile_px, expected)
    tiles = [{row.tobytes() for row in database.tiles} for database in (first, second)]
    both = min(len(first), len(second))
    angles = principal_angles_deg(first.basis, second.basis)
    return CodebookDifference(
        same_identity=first.identity == second.identity,
        same_numbers=int((first.tiles[:both] == second.tiles[:both]).all(axis=1).sum()),
        common=len(tiles[0] & tiles[1]),
        first=_unmatched(first, second, tiles[0], tiles[1]),
        second=_unmatched(second, first, tiles[1], tiles[0]),
        angle_max_deg=float(angles.max()),
        angle_rms_deg=float(np.sqrt(np.mean(angles * angles))),
    )


def principal_angles_deg(first: npt.NDArray[np.int16], second: npt.NDArray[np.int16]) -> npt.NDArray[np.float64]:
    """Return the principal angles between the row spaces of two bases, shape (rows of the smaller,), in degrees."""
    # Knyazev and Argentati (2002): the cosine is inexact for small angles, the sine for large ones.
    one, other = (np.linalg.qr(basis.T.astype(np.float64))[0] for basis in (first, second))
    if one.shape[1] < other.shape[1]:
        one, other = other, one
    product = one.T @ other
    cosines = np.linalg.svd(product, compute_uv=False)
    sines = np.linalg.svd(other - one @ product, compute_uv=False)[::-1]
    small = cosines**2 >= 0.5
    angles = np.where(small, np.arcsin(np.clip(sines, -1, 1)), np.arccos(np.clip(cosines, -1, 1)))
    return np.asarray(np.degrees(np.sort(angles)[::-1]), np.float64)


def _unmatched(
    own: TileDatabase, other: TileDatabase, own_tiles: set[bytes], other_tiles: set[bytes]
) -> UnmatchedTiles:
    search = IncrementalTileSet(other.tile_px, len(other))
    search.append(other.tiles)
    rms = np.sqrt(search.nearest(own.tiles)[1]) / own.tile_px
    median, high = np.percentile(rms, (50, 95))
    return UnmatchedTiles(
        tiles=len(own_tiles),
        only_here=len(own_tiles - other_tiles),
        rms_median=float(median),
        rms_95=float(high),
        rms_max=float(rms.max()),
        variance_own=_variance_fraction(own, own.basis),
        variance_other=_variance_fraction(own, other.basis),
    )


def _variance_fraction(database: TileDatabase, basis: npt.NDArray[np.int16]) -> float:
    centred = database.tiles - database.tiles.mean(axis=0)
    total = float(np.einsum("ij,ij->", centred, centred))
    if total == 0.0:
        return 1.0
    projected = centred @ np.linalg.qr(basis.T.astype(np.float64))[0]
    return float(np.einsum("ij,ij->", projected, projected)) / total
