"""The tile database that both ends of the link share, and the search for the nearest tile.

Tiles are compared in a basis of principal components, as in the paper (70 dimensions). The basis loses the finest
texture of a tile, and a textured tile would be chosen although a smooth one is nearer. The few nearest tiles in the
basis are therefore compared again in all pixels; with 20 x 20 tiles this gains 0.1 to 0.2 dB.

Mean and basis are stored as integers, the basis in units of 1/4096. Projections and squared distances are integers that
float64 holds exactly, so indices do not depend on the processor or the linear-algebra library. A stream has the same
bytes on every machine. The search itself is in `sonarpost.codec.vq.tile_search`.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from sonarpost.codec.vq.tile_search import Distances, Indices, NearestSearch
from sonarpost.errors import CodebookError

MIN_TILE_PX = 4
MAX_TILE_PX = 32  # a squared distance of 32 x 32 tiles in units of (1/4096)^2 still fits float64's 53 bits
MAX_DIMS = 70
BASIS_SCALE = 4096

SHORTLIST = 8
"""Number of nearest tiles in the basis that are compared in all pixels. 32 or 128 give the same images."""

_QUERY_ROWS = 256  # tiles searched at once

Tiles = npt.NDArray[np.uint8]
Basis = npt.NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class TileDatabase:
    """An immutable list of tiles with the basis in which they are compared.

    Attributes:
        tile_px: Side of the square tiles, 4..32 px.
        tiles: Shape (n, tile_px * tile_px), uint8, each row one tile in raster order; n is at least 1.
        mean: Shape (tile_px * tile_px,), uint8, subtracted before projection.
        basis: Shape (dims, tile_px * tile_px), int16, rows are unit vectors times 4096; 1..70 dims.

    Raises:
        CodebookError: A shape, dtype or count is out of range.
    """

    tile_px: int
    tiles: Tiles
    mean: Tiles
    basis: Basis

    def __post_init__(self) -> None:
        pixels = self.tile_px * self.tile_px
        _check("tile_px", self.tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX}", MIN_TILE_PX <= self.tile_px <= MAX_TILE_PX)
        _check_array("tiles", self.tiles, np.dtype(np.uint8), (max(1, self.tiles.shape[0]), pixels))
        _check_array("mean", self.mean, np.dtype(np.uint8), (pixels,))
        dims = min(max(1, self.basis.shape[0]), MAX_DIMS, pixels)
        _check_array("basis", self.basis, np.dtype(np.int16), (dims, pixels))
        for name in ("tiles", "mean", "basis"):
            # A private, read-only copy: `identity` must not change.
            array = np.array(getattr(self, name), order="C")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return int(self.tiles.shape[0])

    @property
    def dims(self) -> int:
        """Dimensions of the basis."""
        return int(self.basis.shape[0])

    @cached_property
    def identity(self) -> str:
        """Hex SHA-256 over all data that affect an image or an index (see docs/specifications/codebook-file.md)."""
        digest = hashlib.sha256(b"sonarpost tile database 1\n")
        digest.update(struct.pack(">HIH", self.tile_px, len(self), self.dims))
        digest.update(self.tiles.tobytes())
        digest.update(self.mean.tobytes())
        digest.update(self.basis.astype(">i2").tobytes())
        return digest.hexdigest()

    @cached_property
    def projections(self) -> npt.NDArray[np.float64]:
        """Coordinates of the tiles in the basis, shape (n, dims), see `project`."""
        projections = self.project(self.tiles)
        projections.setflags(write=False)
        return projections

    def project(self, tiles: Tiles) -> npt.NDArray[np.float64]:
        """Return the coordinates of tiles, shape (m, dims), float64 holding integers, in 1/4096 grey level.

        Args:
            tiles: Shape (m, tile_px * tile_px), uint8.
        """
        centred = tiles.astype(np.float64) - self.mean.astype(np.float64)
        return np.asarray(centred @ self.basis.T.astype(np.float64), dtype=np.float64)

    def nearest(self, tiles: Tiles) -> tuple[Indices, Distances]:
        """Find for each tile the nearest in all pixels among the `SHORTLIST` nearest in the basis.

        Args:
            tiles: Shape (m, tile_px * tile_px), uint8.

        Returns:
            Indices, shape (m,), the lowest among equally near ones; Euclidean distances over all pixels, shape (m,), in
            grey levels.
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
        """Find for each tile the `count` nearest database tiles in the basis. With a count of 1: the paper's search.

        Args:
            tiles: Shape (m, tile_px * tile_px), uint8.
            count: Number of tiles to find, limited to the number of stored tiles.

        Returns:
            Indices, shape (m, count), nearest first, the lowest first among equally near ones; exact distances, same
            shape, in grey levels.
        """
        count = min(count, len(self))
        indices = np.empty((tiles.shape[0], count), dtype=np.int64)
        squared = np.empty((tiles.shape[0], count))
        for start in range(0, tiles.shape[0], _QUERY_ROWS):
            rows = slice(start, start + _QUERY_ROWS)
            queries = self.project(tiles[rows])
            indices[rows], squared[rows] = self._search.nearest(queries, count)
        return indices, np.sqrt(squared) / BASIS_SCALE

    @cached_property
    def _search(self) -> NearestSearch:
        return NearestSearch.over(self.projections)


def cut_tiles(image: npt.NDArray[np.uint8], tile_px: int) -> Tiles:
    """Cut an image into tiles that cover it. Edge tiles repeat the last row and column.

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
    """Join tiles and crop to the image size, shape (height_px, width_px). The inverse of `cut_tiles`."""
    rows, columns = tile_grid(height_px, width_px, tile_px)
    blocks = tiles.reshape(rows, columns, tile_px, tile_px).swapaxes(1, 2)
    return np.ascontiguousarray(blocks.reshape(rows * tile_px, columns * tile_px)[:height_px, :width_px])


def tile_grid(height_px: int, width_px: int, tile_px: int) -> tuple[int, int]:
    """Return the rows and columns of tiles that cover an image."""
    return -(-height_px // tile_px), -(-width_px // tile_px)


def _check(name: str, value: object, expected: str, is_valid: bool) -> None:  # noqa: FBT001 - a condition
    if not is_valid:
        raise CodebookError("tile database", name, value, expected)


def _check_array(
    name: str, array: npt.NDArray[np.generic], dtype: np.dtype[np.generic], shape: tuple[int, ...]
) -> None:
    _check(f"{name}.dtype", str(array.dtype), str(dtype), array.dtype == dtype)
    _check(f"{name}.shape", array.shape, str(shape), array.shape == shape)
