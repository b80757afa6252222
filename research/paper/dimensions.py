"""The paper's Fig. 3: what keeping more principal components costs and gives.

The shipped codec compares tiles in at most 70 dimensions and then in all pixels, and its builder never projects. Here
is the paper's own way instead: one rotation matrix for all, database and search wholly in the rotated space, in float64
as there, so that 10 to 100 dimensions can be compared.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.codec.interface import Image
from sonarpost.codec.quality import fom, psnr_db
from sonarpost.codec.vq.tiles import BASIS_SCALE, Tiles, cut_tiles, join_tiles, principal_basis

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
        dims: Dimensions kept.
        build_s: Time to compute the rotation and to build the database (Table IV).
        encode_ms: Time to encode one picture: the best of five, and of that the median over pictures.
        rotation_bytes: Size of the rotation matrix, float64.
        database_bytes: Size of the database: rotated tiles in float64, and their pixels.
        tiles: Tiles in the database.
        fom: Mean figure of merit over the test pictures.
        psnr: Mean PSNR in dB over the test pictures.
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
    """A tile database in rotated space, as the paper builds it.

    Args:
        training: Every tile of the training pictures, shape (n, pixels), uint8: the rotation is theirs.
        dims: Dimensions kept.
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
        known = self._rotated[: self._count]
        squared = self._norms[: self._count] - 2.0 * (rotated @ known.T)
        best = np.argmin(squared, axis=1)
        own = np.einsum("ij,ij->i", rotated, rotated)
        return best, np.maximum(squared[np.arange(len(best)), best] + own, 0.0)

    def rebuild(self, picture: Image) -> Image:
        """Encode and decode a picture."""
        index, _ = self.nearest(self.rotate(cut_tiles(picture, TILE_PX)))
        return join_tiles(self._tiles[index], picture.shape[0], picture.shape[1], TILE_PX)

    def learn(self, picture: Image) -> None:
        """Do Table IV for one picture: add what is far from everything, one tile after the other."""
        tiles = cut_tiles(picture, TILE_PX)
        rotated = self.rotate(tiles)
        if self._count == 0:
            self._add(tiles[0], rotated[0])
        elif fom(picture, self.rebuild(picture)) >= FOM_BELOW:
            return
        _, squared = self.nearest(rotated)
        for number in np.flatnonzero(squared > DISTANCE_ABOVE**2):
            _, now = self.nearest(rotated[number : number + 1])
            if now[0] > DISTANCE_ABOVE**2:
                self._add(tiles[number], rotated[number])

    def _add(self, tile: Tiles, rotated: _Floats) -> None:
        self._tiles[self._count], self._rotated[self._count] = tile, rotated
        self._norms[self._count] = rotated @ rotated
        self._count += 1


def sensitivity(
    training: Sequence[Image], test: Sequence[Image], dimensions: Sequence[int] = DIMENSIONS
) -> list[DimensionPoint]:
    """Measure Fig. 3's quantities for each number of dimensions.

    Args:
        training: Pictures the databases are built from.
        test: Others, to encode.
        dimensions: Numbers of principal components, 1..400.
    """
    every = np.concatenate([cut_tiles(picture, TILE_PX) for picture in training])
    return [_point(training, test, every, dims) for dims in dimensions]


def _point(training: Sequence[Image], test: Sequence[Image], every: Tiles, dims: int) -> DimensionPoint:
    start_s = time.perf_counter()
    database = RotatedTiles(every, dims)
    for picture in training:
        database.learn(picture)
    build_s = time.perf_counter() - start_s
    times_ms = [min(_encode_ms(database, picture) for _ in range(_ENCODE_REPEATS)) for picture in test]
    rebuilt = [database.rebuild(picture) for picture in test]
    return DimensionPoint(
        dims=dims,
        build_s=build_s,
        encode_ms=float(np.median(times_ms)),
        rotation_bytes=database.rotation.nbytes,
        database_bytes=database.size_bytes,
        tiles=len(database),
        fom=float(np.mean([fom(a, b) for a, b in zip(test, rebuilt, strict=True)])),
        psnr=float(np.mean([psnr_db(a, b) for a, b in zip(test, rebuilt, strict=True)])),
    )


def _encode_ms(database: RotatedTiles, picture: Image) -> float:
    start_s = time.perf_counter()
    database.nearest(database.rotate(cut_tiles(picture, TILE_PX)))
    return (time.perf_counter() - start_s) * 1000.0
