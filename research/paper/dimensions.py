"""The paper's Fig. 3: cost and benefit of more principal components.

The shipped codec compares tiles in at most 70 dimensions and then in all pixels, and its builder does not project. This
module implements the paper's method: one rotation matrix, database and search in the rotated space, in float64, so
that 10 to 100 dimensions can be compared.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from research.codebook.basis import principal_basis
from research.codebook.builder import figure_of_merit
from research.common.quality import psnr_db
from sonarpost.codec.interface import Image
from sonarpost.codec.vq.tiles import BASIS_SCALE, Tiles, cut_tiles, join_tiles

TILE_PX: Final = 20
DIMENSIONS: Final = tuple(range(10, 101, 10))
FOM_BELOW: Final = 39.0  # Table IV
DISTANCE_ABOVE: Final = 320.0  # Table IV
_ENCODE_REPEATS: Final = 5

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DimensionPoint:
    """One point of each of Fig. 3's curves.

    Attributes:
        dims: Number of dimensions.
        build_s: Time to compute the rotation and to build the database (Table IV).
        encode_ms: Time to encode one image: the shortest of five, median over the images.
        rotation_bytes: Size of the rotation matrix, float64.
        database_bytes: Size of the database: rotated tiles in float64, and their pixels.
        tiles: Tiles in the database.
        fom: Mean figure of merit over the test images.
        psnr: Mean PSNR in dB over the test images.
    """

    dims: int
    build_s: float
    encode_ms: float
    rotation_bytes: int
    database_bytes: int
    tiles: int
    fom: float
    psnr: float


class RotatedTiles:
    """A tile database in rotated space, built with the paper's method.

    Args:
        training: All tiles of the training images, shape (n, pixels), uint8; they determine the rotation.
        dims: Number of dimensions.
    """

    def __init__(self, training: Tiles, dims: int) -> None:
        self._mean, basis = principal_basis(training, dims)
        self.rotation: _Floats = basis.T.astype(np.float64) / BASIS_SCALE
        self._tiles = np.empty_like(training)
        self._rotated = np.empty((training.shape[0], self.rotation.shape[1]))
        self._norms = np.empty(training.shape[0])
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def size_bytes(self) -> int:
        """Size of rotated tiles and pixels."""
        return self._count * int(self._rotated.shape[1] * self._rotated.itemsize + self._tiles.shape[1])

    def rotate(self, tiles: Tiles) -> _Floats:
        """Return tiles in rotated space, shape (m, dims)."""
        return np.asarray((tiles.astype(np.float64) - self._mean) @ self.rotation)

    def nearest(self, rotated: _Floats) -> tuple[npt.NDArray[np.int64], _Floats]:
        """Return index and squared distance of the nearest tile for each of `rotated`, shape (m, dims)."""
        stored = self._rotated[: self._count]
        squared = self._norms[: self._count] - 2.0 * (rotated @ stored.T)
        best = np.argmin(squared, axis=1)
        own = np.einsum("ij,ij->i", rotated, rotated)
        return best, np.maximum(squared[np.arange(len(best)), best] + own, 0.0)

    def encode_and_decode(self, image: Image) -> Image:
        """Encode and decode an image."""
        index, _ = self.nearest(self.rotate(cut_tiles(image, TILE_PX)))
        return join_tiles(self._tiles[index], image.shape[0], image.shape[1], TILE_PX)

    def add_tiles_of(self, image: Image) -> None:
        """Apply Table IV to one image: add each tile that is far from all tiles of the database."""
        tiles = cut_tiles(image, TILE_PX)
        rotated = self.rotate(tiles)
        if self._count == 0:
            self._add(tiles[0], rotated[0])
        elif figure_of_merit(image, self.encode_and_decode(image)) >= FOM_BELOW:
            return
        _, squared = self.nearest(rotated)
        for number in np.flatnonzero(squared > DISTANCE_ABOVE**2):
            _, current = self.nearest(rotated[number : number + 1])
            if current[0] > DISTANCE_ABOVE**2:
                self._add(tiles[number], rotated[number])

    def _add(self, tile: Tiles, rotated: _Floats) -> None:
        self._tiles[self._count], self._rotated[self._count] = tile, rotated
        self._norms[self._count] = rotated @ rotated
        self._count += 1


def sensitivity(
    training: Sequence[Image], test: Sequence[Image], dimensions: Sequence[int] = DIMENSIONS
) -> list[DimensionPoint]:
    """Measure the quantities of Fig. 3 for each number of dimensions.

    Args:
        training: Images from which the databases are built.
        test: Other images, to encode.
        dimensions: Numbers of principal components, 1..400.
    """
    all_tiles = np.concatenate([cut_tiles(image, TILE_PX) for image in training])
    return [_point(training, test, all_tiles, dims) for dims in dimensions]


def _point(training: Sequence[Image], test: Sequence[Image], all_tiles: Tiles, dims: int) -> DimensionPoint:
    start_s = time.perf_counter()
    database = RotatedTiles(all_tiles, dims)
    for image in training:
        database.add_tiles_of(image)
    build_s = time.perf_counter() - start_s
    times_ms = [min(_encode_ms(database, image) for _ in range(_ENCODE_REPEATS)) for image in test]
    decoded = [database.encode_and_decode(image) for image in test]
    return DimensionPoint(
        dims=dims,
        build_s=build_s,
        encode_ms=float(np.median(times_ms)),
        rotation_bytes=database.rotation.nbytes,
        database_bytes=database.size_bytes,
        tiles=len(database),
        fom=float(np.mean([figure_of_merit(a, b) for a, b in zip(test, decoded, strict=True)])),
        psnr=float(np.mean([psnr_db(a, b) for a, b in zip(test, decoded, strict=True)])),
    )


def _encode_ms(database: RotatedTiles, image: Image) -> float:
    start_s = time.perf_counter()
    database.nearest(database.rotate(cut_tiles(image, TILE_PX)))
    return (time.perf_counter() - start_s) * 1000.0
