"""Adapt a codebook to a type of seabed: its least used tiles make room for tiles that a set of images needs.

The rule:

1. Each image is cut into tiles four times: from its corner and from half a tile further, as it is and mirrored (port
   and starboard cast shadows to opposite sides). Without this a tile learned stands for too few pieces of bottom:
   measured, it doubles the gain.
2. Every training tile is encoded with the base codebook, and the uses of each base tile are counted. Base tiles are
   given up from the least used (of equals the last) on; free places up to `max_tiles` are taken first. At least `keep`
   base tiles stay, the most used. All stay at their numbers, unchanged.
3. New tiles are drawn from the training tiles in eight steps. In each, the squared distances of all training tiles to
   their nearest tile so far are summed up in order, and the tiles are taken in which the sum passes equal steps: a
   tile is the likelier the worse it is rebuilt, and no chance is involved (k-means++ seeding, Arthur and
   Vassilvitskii, SODA 2007, with several tiles a step as in k-means||, Bahmani et al., VLDB 2012, and systematic
   sampling in place of random).
4. New tiles (only these) are moved to the mean of the training tiles nearest to them, `passes` times.
5. New tiles get the numbers of those given up; a new tile that came to equal another is dropped for the tile it would
   have replaced. The basis is computed anew from all tiles.

Images are loaded anew each time they are needed: besides tiles, only one number for each training tile is held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sonarpost.codec.quality import fom, psnr_db
from sonarpost.codec.vq.incremental import IncrementalTileSet
from sonarpost.codec.vq.refinement import refine_once
from sonarpost.codec.vq.tiles import TileDatabase, Tiles, cut_tiles, join_tiles
from sonarpost.codec.vq.training_config import MAX_TILES, TrainingImage
from sonarpost.errors import ConfigError

_STEPS = 8
EQUAL_PSNR_DB = 99.0
"""Stands for the infinite PSNR of a picture that came back exactly, so that a mean over pictures stays finite."""

Squared = npt.NDArray[np.int64]


@dataclass(frozen=True)
class AdaptedCodebook:
    """An adapted codebook.

    Attributes:
        tiles: The database.
        used: Base tiles that the training images use.
        replaced: Base tiles given up.
        new: Tiles that were drawn from the training images.
    """

    tiles: TileDatabase
    used: int
    replaced: int
    new: int


@dataclass(frozen=True)
class CodebookQuality:
    """How well a codebook rebuilds one picture, as the codec does: PSNR in dB, and the figure of merit."""

    psnr_db: float
    fom: float


def adapt(
    base: TileDatabase,
    images: Sequence[TrainingImage],
    *,
    max_tiles: int = MAX_TILES,
    keep: int | None = None,
    passes: int = 4,
    told: Callable[[str, int, int], None] | None = None,
) -> AdaptedCodebook:
    """Adapt a codebook (module docstring). The same base and images in the same order give the same codebook.

    Args:
        base: The codebook to start from.
        images: Pictures of the seabed to adapt to.
        max_tiles: Most tiles of the result; no fewer than the base has.
        keep: Base tiles that stay at least; half of them if None.
        passes: Passes of refinement of the new tiles.
        told: Called with a step's name, what is done of it and what there is to do.

    Raises:
        ConfigError: No images, or a number out of range.
    """
    keep = len(base) // 2 if keep is None else keep
    _check(base, images, max_tiles, keep)
    told = told or (lambda what, done, whole: None)
    images = _views(images, base.tile_px)
    uses = _uses(base, images, told)
    free = max_tiles - len(base)
    by_use = np.lexsort((-np.arange(len(base)), uses))  # least used first, of equals the last
    room = free + len(base) - keep
    given_up = by_use[: max(0, min(room, int(_tiles_of(images, base.tile_px))) - free)]
    stays = np.setdiff1d(np.arange(len(base)), given_up)
    growing = IncrementalTileSet(base.tile_px, max_tiles)
    growing.append(base.tiles[stays])
    _draw(growing, images, free + given_up.size, told)
    new = _refined(growing.tiles(), stays.size, base.tile_px, images, passes, told)
    places = np.sort(given_up)
    tiles = np.concatenate((base.tiles, new[places.size :]))
    tiles[places[: new.shape[0]]] = new[: places.size]
    adapted = TileDatabase.from_tiles(base.tile_px, tiles, base.dims)
    replaced = int((tiles[: len(base)] != base.tiles).any(axis=1).sum())
    return AdaptedCodebook(adapted, int((uses > 0).sum()), replaced, new.shape[0])


def split(images: Sequence[TrainingImage]) -> tuple[list[TrainingImage], list[TrainingImage]]:
    """Return images to learn from, and the last quarter, at least one, to measure on.

    Neighbours in a folder often show the same piece of bottom, so what is held out is one stretch, not every fourth.

    Raises:
        ConfigError: Fewer than two images.
    """
    if len(images) < 2:
        raise ConfigError("codebook adaptation", "images", len(images), "at least 2: some to learn from, some to test")
    held_out = max(1, len(images) // 4)
    return list(images[:-held_out]), list(images[-held_out:])


def measure(database: TileDatabase, images: Sequence[TrainingImage]) -> list[CodebookQuality]:
    """Rebuild each picture from the tiles that the codec would choose, and measure it."""
    measured = []
    for image in images:
        pixels = image.load()
        index, _ = database.nearest(cut_tiles(pixels, database.tile_px))
        rebuilt = join_tiles(database.tiles[index], pixels.shape[0], pixels.shape[1], database.tile_px)
        measured.append(CodebookQuality(min(psnr_db(pixels, rebuilt), EQUAL_PSNR_DB), fom(pixels, rebuilt)))
    return measured


def _check(base: TileDatabase, images: Sequence[TrainingImage], max_tiles: int, keep: int) -> None:
    where = "codebook adaptation"
    if not images:
        raise ConfigError(where, "images", 0, "at least one image")
    if max_tiles < len(base):
        raise ConfigError(where, "max_tiles", max_tiles, f"at least {len(base)}, the tiles of the base")
    if not 0 <= keep <= len(base):
        raise ConfigError(where, "keep", keep, f"0..{len(base)}, the tiles of the base")


def _views(images: Sequence[TrainingImage], tile_px: int) -> list[TrainingImage]:
    """Return each image as it is cut: see the module's first rule. Too small to be shifted, it is left as it is."""

    def view(image: TrainingImage, shift_px: int, step: int) -> TrainingImage:
        def load() -> npt.NDArray[np.uint8]:
            pixels = image.load()
            first = shift_px if min(pixels.shape) > shift_px else 0
            return np.ascontiguousarray(pixels[first:, first:][:, ::step])

        return TrainingImage(image.name, load)

    return [view(image, shift, step) for image in images for shift in (0, tile_px // 2) for step in (1, -1)]


def _tiles_of(images: Sequence[TrainingImage], tile_px: int) -> int:
    return sum(cut_tiles(image.load(), tile_px).shape[0] for image in images)


def _uses(
    base: TileDatabase, images: Sequence[TrainingImage], told: Callable[[str, int, int], None]
) -> npt.NDArray[np.int64]:
    uses = np.zeros(len(base), dtype=np.int64)
    for done, image in enumerate(images, 1):
        index, _ = base.nearest(cut_tiles(image.load(), base.tile_px))
        uses += np.bincount(index, minlength=len(base))
        told("counting uses", done, len(images))
    return uses


def _draw(
    growing: IncrementalTileSet, images: Sequence[TrainingImage], wanted: int, told: Callable[[str, int, int], None]
) -> None:
    """Add `wanted` training tiles to `growing`, or fewer if there are not so many different ones."""
    before = len(growing)
    squared = _squared(growing, images, None)
    for step in range(_STEPS):
        left = wanted - (len(growing) - before)
        picked = _systematic(squared, -(-left // (_STEPS - step)))
        if picked.size == 0:
            break
        start = len(growing)
        # Pieces drawn in one step may be the same: only the first of them is added.
        growing.add_far(_at(images, growing.tile_px, picked), squared[picked].astype(np.float64), 0.0)
        fresh = IncrementalTileSet(growing.tile_px, len(growing) - start)
        fresh.append(growing.tiles_at(np.arange(start, len(growing))))
        squared = _squared(fresh, images, squared)
        told("drawing tiles", step + 1, _STEPS)


def _squared(growing: IncrementalTileSet, images: Sequence[TrainingImage], least: Squared | None) -> Squared:
    """Return squared distances of all training tiles to the nearest tile, or to that of `least` where it is nearer."""
    parts = []
    start = 0
    for image in images:
        tiles = cut_tiles(image.load(), growing.tile_px)
        squared = growing.nearest(tiles)[1].astype(np.int64) if len(growing) else _NO_TILE + np.zeros(len(tiles), int)
        parts.append(squared if least is None else np.minimum(squared, least[start : start + squared.size]))
        start += squared.size
    return np.concatenate(parts)


_NO_TILE = np.int64(1 << 27)
"""Squared distance to the nearest of no tiles: as far as tiles of 32 x 32 px can be, and more."""


def _systematic(squared: Squared, wanted: int) -> npt.NDArray[np.int64]:
    """Return the places, ascending, where the running sum of `squared` passes the middles of `wanted` equal parts."""
    running = np.cumsum(squared)
    total = int(running[-1])
    if total == 0 or wanted < 1:
        return np.empty(0, dtype=np.int64)
    middles = [(2 * part + 1) * total // (2 * wanted) for part in range(wanted)]
    return np.unique(np.searchsorted(running, np.array(middles, dtype=np.int64), side="right"))


def _at(images: Sequence[TrainingImage], tile_px: int, picked: npt.NDArray[np.int64]) -> Tiles:
    """Return the training tiles of these numbers, counted through all images."""
    found = []
    start = 0
    for image in images:
        tiles = cut_tiles(image.load(), tile_px)
        here = picked[(picked >= start) & (picked < start + tiles.shape[0])]
        found.append(tiles[here - start])
        start += tiles.shape[0]
    return np.concatenate(found)


def _refined(
    tiles: Tiles,
    fixed: int,
    tile_px: int,
    images: Sequence[TrainingImage],
    passes: int,
    told: Callable[[str, int, int], None],
) -> Tiles:
    """Refine all tiles but the first `fixed`; return those refined that equal no other."""
    tiles = tiles.copy()
    for number in range(passes):
        tiles[fixed:] = refine_once(tiles, tile_px, images).tiles[fixed:]
        told("refining", number + 1, passes)
    _, first = np.unique(tiles, axis=0, return_index=True)
    return tiles[np.sort(first[first >= fixed])]
