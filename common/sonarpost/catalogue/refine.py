"""An optional step after Table IV: move each tile to the middle of what it stands for.

Table IV stops when a database is full; which of many similar pieces of speckle got in is then a matter of order. One
pass here gives every training tile to its nearest database tile and replaces each database tile by the rounded mean of
those given to it (the Linde-Buzo-Gray step of vector quantiser design, IEEE Trans. Communications 28(1), 1980). The
squared error over the training tiles cannot grow, apart from rounding. A tile nothing was given to stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sonarpost.catalogue.build import GrowingTiles, TrainingImage
from sonarpost.codec.tiles import TileDatabase, Tiles, cut_tiles

_BATCH_TILES = 4096


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
        tiles, rms = _one_pass(tiles, database.tile_px, images)
        if progress is not None:
            progress(number, rms)
    # Means may coincide where tiles were nearly the same; a doubled tile would only waste an index.
    _, first = np.unique(tiles, axis=0, return_index=True)
    return TileDatabase.from_tiles(database.tile_px, tiles[np.sort(first)], database.dims) if passes else database


def _one_pass(tiles: Tiles, tile_px: int, images: Sequence[TrainingImage]) -> tuple[Tiles, float]:
    search = GrowingTiles(tile_px, tiles.shape[0])
    search.append(tiles)
    sums = np.zeros(tiles.shape, dtype=np.int64)
    counts = np.zeros(tiles.shape[0], dtype=np.int64)
    squared_error = 0.0
    for batch in _batches(images, tile_px):
        index, squared = search.nearest(batch)
        order = np.argsort(index, kind="stable")
        present, starts = np.unique(index[order], return_index=True)
        sums[present] += np.add.reduceat(batch[order].astype(np.int64), starts, axis=0)
        counts[present] += np.diff(np.append(starts, index.size))
        squared_error += float(squared.sum())
    used = counts > 0
    means = tiles.copy()
    means[used] = ((2 * sums[used] + counts[used, None]) // (2 * counts[used, None])).astype(np.uint8)
    pixels = max(int(counts.sum()), 1) * tile_px * tile_px
    return means, float(np.sqrt(squared_error / pixels))


def _batches(images: Sequence[TrainingImage], tile_px: int) -> list[Tiles]:
    batches: list[Tiles] = []
    waiting: list[Tiles] = []
    for image in images:
        waiting.append(cut_tiles(image.load(), tile_px))
        if sum(tiles.shape[0] for tiles in waiting) >= _BATCH_TILES:
            batches.append(np.concatenate(waiting))
            waiting = []
    if waiting:
        batches.append(np.concatenate(waiting))
    return batches
