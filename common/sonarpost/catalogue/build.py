"""Build a tile database from images: the paper's Table IV, in rounds.

The first image's tiles all go in. Every further image is rebuilt with the tiles there are so far; where its figure of
merit is below the round's threshold, each of its tiles that lies farther than the round's distance from its nearest
tile is added, one after the other, so a tile just added counts for the next. Exact duplicates are never added.

Distances here are Euclidean in **all** pixels of a tile, not in the principal components: the components are those of
the finished database, so they cannot be known while it grows, and the threshold has a meaning in grey levels. The
paper's 320 is for 400-pixel tiles: 16 grey levels RMS; `rms_distance` gives the same for any tile. The basis that the
encoder searches in is computed once, at the end, from all tiles.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarpost.catalogue.journal import Journal, JournalEntry
from sonarpost.codec.quality import FigureOfMerit, fom
from sonarpost.codec.tiles import MAX_TILE_PX, MIN_TILE_PX, TileDatabase, Tiles, cut_tiles, join_tiles
from sonarpost.errors import ConfigError

MAX_TILES = 15_992
"""The paper's database; index + 1 fits 14 bits with room to spare."""

_CENTRE = 128
_TILE_BLOCK = 4096


def rms_distance(grey_levels: float, tile_px: int) -> float:
    """Return the Euclidean distance of tiles that differ by `grey_levels` RMS (16 at 20 px is the paper's 320)."""
    return grey_levels * tile_px


@dataclass(frozen=True)
class Round:
    """One pass over the images.

    Attributes:
        fom_below: Images rebuilt with a figure of merit below this contribute tiles.
        distance_above: Only tiles farther than this from their nearest tile are added.
        max_images: How many images are looked at, spread evenly over the list; None for all.
    """

    fom_below: float
    distance_above: float
    max_images: int | None = None


@dataclass(frozen=True)
class TrainingImage:
    """One image to learn from.

    Attributes:
        name: Names it in messages and in the journal.
        load: Returns its pixels, shape (height, width), uint8.
    """

    name: str
    load: Callable[[], npt.NDArray[np.uint8]]


@dataclass(frozen=True)
class Progress:
    """Told after every image: where the build stands. `fom` is NaN for the very first image."""

    round_number: int
    image_number: int
    images_in_round: int
    name: str
    fom: float
    added: int
    tiles: int


class GrowingTiles:
    """Tiles that grow, with an exact nearest search over all pixels.

    Pixels are held centred on 128 as float32: products of two tiles of at most 32 x 32 px then never exceed 2^24, so
    every partial sum of the matrix product is an exact integer and the result does not depend on the machine.
    """

    def __init__(self, tile_px: int, capacity: int) -> None:
        self.tile_px = tile_px
        self.capacity = capacity
        self._count = 0
        self._centred = np.empty((min(capacity, 1024), tile_px * tile_px), dtype=np.float32)
        self._norms = np.empty(self._centred.shape[0], dtype=np.float64)

    def __len__(self) -> int:
        return self._count

    @property
    def full(self) -> bool:
        """Whether no further tile fits."""
        return self._count >= self.capacity

    def tiles(self) -> Tiles:
        """Return the tiles, shape (n, pixels), uint8, in the order they were added."""
        return (self._centred[: self._count] + _CENTRE).astype(np.uint8)

    def tiles_at(self, index: npt.NDArray[np.int64]) -> Tiles:
        """Return the tiles of these indices, shape (m, pixels), uint8."""
        return (self._centred[index] + _CENTRE).astype(np.uint8)

    def append(self, tiles: Tiles) -> None:
        """Add tiles, shape (m, pixels), uint8. The caller keeps to the capacity."""
        end = self._count + tiles.shape[0]
        if end > self._centred.shape[0]:
            size = min(max(end, 2 * self._centred.shape[0]), max(self.capacity, end))
            self._centred = np.resize(self._centred, (size, self._centred.shape[1]))
            self._norms = np.resize(self._norms, size)
        self._centred[self._count : end] = _centred(tiles)
        self._norms[self._count : end] = _squared_norms(self._centred[self._count : end])
        self._count = end

    def nearest(self, tiles: Tiles) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Return index and squared distance of the nearest tile (the lowest index of equals) for each of `tiles`."""
        queries = _centred(tiles)
        rows = np.arange(tiles.shape[0])
        best = np.zeros(tiles.shape[0], dtype=np.int64)
        least = np.full(tiles.shape[0], np.inf)
        for start in range(0, self._count, _TILE_BLOCK):
            stop = min(start + _TILE_BLOCK, self._count)
            scores = (queries @ self._centred[start:stop].T).astype(np.float64)
            scores *= -2.0
            scores += self._norms[start:stop]
            candidate = np.argmin(scores, axis=1)
            value = scores[rows, candidate]
            better = value < least
            best[better], least[better] = candidate[better] + start, value[better]
        return best, least + _squared_norms(queries)

    def add_far(self, tiles: Tiles, squared_distance: npt.NDArray[np.float64], above: float) -> Tiles:
        """Add, in order, each tile farther than `above` from all tiles, those just added included.

        Args:
            tiles: Shape (m, pixels), uint8.
            squared_distance: Shape (m,), squared distance of each to its nearest present tile.
            above: Distance that must be exceeded; 0 still refuses exact duplicates.

        Returns:
            The added tiles, shape (0..m, pixels), uint8.
        """
        far = np.flatnonzero(squared_distance > above * above)
        chosen: list[int] = []
        pool = _centred(tiles[far])
        norms = _squared_norms(pool)
        least = squared_distance[far].copy()
        for position in range(far.size):
            if self._count + len(chosen) >= self.capacity:
                break
            if least[position] > above * above:
                chosen.append(position)
                to_others = norms + norms[position] - 2.0 * (pool @ pool[position]).astype(np.float64)
                np.minimum(least, to_others, out=least)
        added = np.ascontiguousarray(tiles[far[chosen]])
        self.append(added)
        return added


def build(
    images: Sequence[TrainingImage],
    tile_px: int,
    rounds: Sequence[Round],
    *,
    max_tiles: int = MAX_TILES,
    dims: int = 70,
    core: TileDatabase | None = None,
    journal_path: Path | None = None,
    figure_of_merit: FigureOfMerit = fom,
    progress: Callable[[Progress], None] | None = None,
) -> TileDatabase:
    """Build a database (module docstring). The same images in the same order give the same database.

    Args:
        images: What to learn from, in order; the first one's tiles all go in unless `core` is given.
        tile_px: Side of a tile, 4..32 px.
        rounds: Passes over the images, in order.
        max_tiles: The build ends when this many tiles are in.
        dims: Dimensions of the encoder's search space, 1..70.
        core: A finished database to add to (Table IV's "database core is not empty").
        journal_path: Where every image's tiles are written as soon as they are known. If the file exists, the build
            goes on from it, so a build that was killed loses at most the image it was working on.
        figure_of_merit: Takes original and rebuilt picture; larger is better.
        progress: Called after every image that was worked on in this run.

    Raises:
        ConfigError: No images, no rounds, or a number out of range.
        CatalogueError: The journal belongs to another build, or cannot be read or written.
    """
    _check_plan(images, tile_px, rounds, max_tiles, core)
    growing = GrowingTiles(tile_px, max_tiles)
    if core is not None:
        growing.append(core.tiles)
    plan = _fingerprint(images, tile_px, rounds, max_tiles, core)
    done: set[tuple[int, int]] = set()
    with Journal(journal_path, plan, tile_px * tile_px) as journal:
        for entry in journal.entries:
            growing.append(entry.tiles)
            done.add((entry.round_number, entry.image_number))
        for round_number, settings in enumerate(rounds):
            chosen = spread(len(images), settings.max_images)
            for image_number in chosen:
                if growing.full or (round_number, image_number) in done:
                    continue
                image = images[image_number].load()
                merit, added = _learn(growing, image, settings, figure_of_merit)
                journal.append(JournalEntry(round_number, image_number, added))
                if progress is not None:
                    counts = (added.shape[0], len(growing))
                    progress(
                        Progress(round_number, image_number, len(chosen), images[image_number].name, merit, *counts)
                    )
    return TileDatabase.from_tiles(tile_px, growing.tiles(), dims)


def spread(available: int, wanted: int | None) -> tuple[int, ...]:
    """Return at most `wanted` of the numbers 0..available-1, evenly spread, the first always among them."""
    if wanted is None or wanted >= available:
        return tuple(range(available))
    return tuple(i * available // wanted for i in range(wanted))


def _learn(
    growing: GrowingTiles, image: npt.NDArray[np.uint8], settings: Round, figure_of_merit: FigureOfMerit
) -> tuple[float, Tiles]:
    """Table IV for one image: return its figure of merit before, and the tiles it added."""
    tiles = cut_tiles(image, growing.tile_px)
    if len(growing) == 0:
        return float("nan"), growing.add_far(tiles, np.full(tiles.shape[0], np.inf), 0.0)
    index, squared = growing.nearest(tiles)
    rebuilt = join_tiles(growing.tiles_at(index), image.shape[0], image.shape[1], growing.tile_px)
    merit = figure_of_merit(image, rebuilt)
    if merit >= settings.fom_below:
        return merit, tiles[:0]
    return merit, growing.add_far(tiles, squared, settings.distance_above)


def _centred(tiles: Tiles) -> npt.NDArray[np.float32]:
    return tiles.astype(np.float32) - np.float32(_CENTRE)


def _squared_norms(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    wide = values.astype(np.float64)
    return np.asarray(np.einsum("ij,ij->i", wide, wide), dtype=np.float64)


def _check_plan(
    images: Sequence[TrainingImage], tile_px: int, rounds: Sequence[Round], max_tiles: int, core: TileDatabase | None
) -> None:
    def refuse(field: str, value: object, expected: str) -> None:
        raise ConfigError("catalogue build", field, value, expected)

    if not images:
        refuse("images", 0, "at least one image")
    if not rounds:
        refuse("rounds", 0, "at least one round")
    if not MIN_TILE_PX <= tile_px <= MAX_TILE_PX:
        refuse("tile_px", tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX} px")
    for number, settings in enumerate(rounds):
        if not settings.distance_above >= 0:
            refuse(f"rounds[{number}].distance_above", settings.distance_above, "zero or more")
        if settings.max_images is not None and settings.max_images < 1:
            refuse(f"rounds[{number}].max_images", settings.max_images, "at least 1, or none for all")
    if core is not None and core.tile_px != tile_px:
        refuse("core.tile_px", core.tile_px, f"{tile_px}, the tile size of this build")
    if max_tiles < (1 if core is None else len(core)):
        refuse("max_tiles", max_tiles, "at least 1 and no fewer than the core has")


def _fingerprint(
    images: Sequence[TrainingImage], tile_px: int, rounds: Sequence[Round], max_tiles: int, core: TileDatabase | None
) -> str:
    """Everything a resumed build must have in common with the one it goes on with, as text."""
    lines = [f"tile_px {tile_px}", f"max_tiles {max_tiles}", f"core {core.identity if core is not None else 'none'}"]
    lines += [f"round {r.fom_below!r} {r.distance_above!r} {r.max_images!r}" for r in rounds]
    lines += [f"image {image.name}" for image in images]
    return "\n".join(lines)
