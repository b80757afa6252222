"""An optional step after Table IV: move each tile to the middle of what it stands for.

Table IV stops when a database is full; which of many similar pieces of speckle got in is then a matter of order. One
pass here gives every training tile to its nearest database tile and replaces each database tile by the rounded mean of
those given to it (the Linde-Buzo-Gray step of vector quantiser design, IEEE Trans. Communications 28(1), 1980). The
squared error over the training tiles cannot grow, apart from rounding. A tile nothing was given to stays as it is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sonarpost.codec.vq.incremental import IncrementalTileSet
from sonarpost.codec.vq.tiles import TileDatabase, Tiles, cut_tiles
from sonarpost.codec.vq.training_config import TrainingImage, pixels_hash

_BATCH_TILES = 4096


@dataclass(frozen=True)
class RefinedTiles:
    """What one pass gave.

    Attributes:
        tiles: Shape (n, pixels), uint8: the means.
        rms: Error of the tiles as they were before, grey levels RMS over all training tiles.
        images_hash: sha256 over the hashes of all images' pixels, in their order.
    """

    tiles: Tiles
    rms: float
    images_hash: bytes


def refine(
    database: TileDatabase,
    images: Sequence[TrainingImage],
    passes: int,
    progress: Callable[[int, float], None] | None = None,
) -> TileDatabase:
    """Return a database whose tiles are means of the training tiles nearest to them.

    Args:
        database: What Table IV gave.
        images: The training images.
        passes: How often to repeat; 0 gives `database` back.
        progress: Called after each pass with its number, from 1, and the RMS error in grey levels before it.
    """
    tiles = database.tiles
    for number in range(1, passes + 1):
        refined = refine_once(tiles, database.tile_px, images)
        tiles = refined.tiles
        if progress is not None:
            progress(number, refined.rms)
    return TileDatabase.from_tiles(database.tile_px, without_duplicates(tiles), database.dims) if passes else database


def refine_once(
    tiles: Tiles, tile_px: int, images: Sequence[TrainingImage], told: Callable[[int], None] | None = None
) -> RefinedTiles:
    """Do one pass.

    Args:
        tiles: Shape (n, pixels), uint8.
        tile_px: Side of a tile.
        images: The training images; one batch of their tiles is held at a time.
        told: Called after each batch with the number of images done.
    """
    search = IncrementalTileSet(tile_px, tiles.shape[0])
    search.append(tiles)
    sums = np.zeros(tiles.shape, dtype=np.int64)
    counts = np.zeros(tiles.shape[0], dtype=np.int64)
    squared_error = 0.0
    digest = hashlib.sha256()
    for batch, done in _batches(images, tile_px, digest.update):
        index, squared = search.nearest(batch)
        order = np.argsort(index, kind="stable")
        present, starts = np.unique(index[order], return_index=True)
        sums[present] += np.add.reduceat(batch[order].astype(np.int64), starts, axis=0)
        counts[present] += np.diff(np.append(starts, index.size))
        squared_error += float(squared.sum())
        if told is not None:
            told(done)
    used = counts > 0
    means = tiles.copy()
    means[used] = ((2 * sums[used] + counts[used, None]) // (2 * counts[used, None])).astype(np.uint8)
    pixels = max(int(counts.sum()), 1) * tile_px * tile_px
    return RefinedTiles(means, float(np.sqrt(squared_error / pixels)), digest.digest())


def without_duplicates(tiles: Tiles) -> Tiles:
    """Return each tile once, in order: means may coincide, and a doubled tile would only waste an index."""
    _, first = np.unique(tiles, axis=0, return_index=True)
    return tiles[np.sort(first)]


def _batches(
    images: Sequence[TrainingImage], tile_px: int, hashed: Callable[[bytes], None]
) -> Iterator[tuple[Tiles, int]]:
    """Yield tiles of several images at a time, with how many images are done; each is loaded when its turn comes."""
    waiting: list[Tiles] = []
    for number, image in enumerate(images, 1):
        pixels = image.load()
        hashed(pixels_hash(pixels))
        waiting.append(cut_tiles(pixels, tile_px))
        if sum(tiles.shape[0] for tiles in waiting) >= _BATCH_TILES:
            yield np.concatenate(waiting), number
            waiting = []
    if waiting:
        yield np.concatenate(waiting), len(images)
