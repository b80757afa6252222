"""How two codebooks differ: which tiles only one has, how far apart the others lie, how alike their bases are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.codec.vq.incremental import IncrementalTileSet
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import CodebookError


@dataclass(frozen=True)
class UnmatchedTiles:
    """One codebook as seen from the other.

    Attributes:
        tiles: How many it has, doubles counted once.
        only_here: How many of them the other has not, pixel for pixel.
        rms_median: Distance of a tile from the other's nearest, grey levels RMS over its pixels: median.
        rms_95: The same, 95th percentile.
        rms_largest: The same, largest.
        variance_own: Part of its tiles' variance that its own basis sees, 0..1.
        variance_other: Part that the other's basis sees.
    """

    tiles: int
    only_here: int
    rms_median: float
    rms_95: float
    rms_largest: float
    variance_own: float
    variance_other: float


@dataclass(frozen=True)
class CodebookDifference:
    """How two codebooks of the same tile size differ.

    Attributes:
        same_identity: Whether streams made with one are read with the other.
        same_places: Numbers (places in the list) at which both hold the same tile.
        common: Tiles that both have, wherever they stand.
        first: The first, seen from the second.
        second: The second, seen from the first.
        angle_largest_deg: Largest principal angle between the spaces that the bases span.
        angle_rms_deg: Root mean square of all principal angles.
    """

    same_identity: bool
    same_places: int
    common: int
    first: UnmatchedTiles
    second: UnmatchedTiles
    angle_largest_deg: float
    angle_rms_deg: float


def compare(first: TileDatabase, second: TileDatabase) -> CodebookDifference:
    """Compare two codebooks.

    Raises:
        CodebookError: Their tiles are of different size, so no distance is defined between them.
    """
    if first.tile_px != second.tile_px:
        expected = f"{first.tile_px} px as in the first: tiles of different size cannot be compared"
        raise CodebookError("second codebook", "tile_px", second.tile_px, expected)
    tiles = [{row.tobytes() for row in database.tiles} for database in (first, second)]
    both = min(len(first), len(second))
    angles = principal_angles_deg(first.basis, second.basis)
    return CodebookDifference(
        same_identity=first.identity == second.identity,
        same_places=int((first.tiles[:both] == second.tiles[:both]).all(axis=1).sum()),
        common=len(tiles[0] & tiles[1]),
        first=_one_side(first, second, tiles[0], tiles[1]),
        second=_one_side(second, first, tiles[1], tiles[0]),
        angle_largest_deg=float(angles.max()),
        angle_rms_deg=float(np.sqrt(np.mean(angles * angles))),
    )


def principal_angles_deg(one: npt.NDArray[np.int16], other: npt.NDArray[np.int16]) -> npt.NDArray[np.float64]:
    """Return the principal angles between the row spaces of two bases, shape (the smaller number of rows,), degrees.

    Sines come from what is left of one space outside the other, because an arc cosine is blind to small angles (Knyazev
    and Argentati, SIAM J. Scientific Computing 23(6), 2002).
    """
    if one.shape[0] < other.shape[0]:
        one, other = other, one
    larger = np.linalg.qr(one.T.astype(np.float64))[0]
    smaller = np.linalg.qr(other.T.astype(np.float64))[0]
    cosines = np.linalg.svd(larger.T @ smaller, compute_uv=False)
    sines = np.linalg.svd(smaller - larger @ (larger.T @ smaller), compute_uv=False)[::-1]
    angles = np.where(cosines * cosines >= 0.5, np.arcsin(np.clip(sines, 0, 1)), np.arccos(np.clip(cosines, 0, 1)))
    return np.asarray(np.degrees(angles), dtype=np.float64)


def _one_side(own: TileDatabase, other: TileDatabase, own_tiles: set[bytes], other_tiles: set[bytes]) -> UnmatchedTiles:
    search = IncrementalTileSet(other.tile_px, len(other))
    search.append(other.tiles)
    rms = np.sqrt(search.nearest(own.tiles)[1]) / own.tile_px
    median, high = np.percentile(rms, (50, 95))
    return UnmatchedTiles(
        tiles=len(own_tiles),
        only_here=len(own_tiles - other_tiles),
        rms_median=float(median),
        rms_95=float(high),
        rms_largest=float(rms.max()),
        variance_own=_variance_seen(own, own.basis),
        variance_other=_variance_seen(own, other.basis),
    )


def _variance_seen(database: TileDatabase, basis: npt.NDArray[np.int16]) -> float:
    centred = database.tiles - database.tiles.mean(axis=0)
    whole = float(np.einsum("ij,ij->", centred, centred))
    if whole == 0.0:
        return 1.0
    seen = centred @ np.linalg.qr(basis.T.astype(np.float64))[0]
    return float(np.einsum("ij,ij->", seen, seen)) / whole
