"""The basis of a codebook: principal components of its own tiles."""

import numpy as np

from sonarpost.codec.vq.tiles import BASIS_SCALE, MAX_DIMS, Basis, TileDatabase, Tiles
from sonarpost.errors import CodebookError


def database_of(tile_px: int, tiles: Tiles, dims: int = MAX_DIMS) -> TileDatabase:
    """Build a database with the principal components of its own tiles as basis.

    Args:
        tile_px: Side of a tile in pixels.
        tiles: Shape (n, tile_px * tile_px), uint8.
        dims: Dimensions to keep, 1..70. Fewer are kept if the tiles span fewer.

    Raises:
        CodebookError: A shape, dtype or count is out of range.
    """
    if not 1 <= dims <= MAX_DIMS:
        raise CodebookError("tile database", "dims", dims, f"1..{MAX_DIMS}")
    if tiles.dtype != np.uint8 or tiles.ndim != 2 or not len(tiles) or tiles.shape[1] != tile_px * tile_px:
        raise CodebookError("tile database", "tiles", (tiles.dtype, tiles.shape), f"uint8, (n, {tile_px * tile_px})")
    return TileDatabase(tile_px, tiles, *principal_basis(tiles, dims))


def principal_basis(tiles: Tiles, dims: int) -> tuple[Tiles, Basis]:
    """Return the rounded mean and the leading principal components of `tiles`, as integers.

    Sums and products of pixels are exact integers. Only the eigenvectors of the covariance are floating point; they are
    rounded to 1/4096. The first entry of largest magnitude of each component is positive. Components without variance
    are dropped, except the first.

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
