"""Adapt a codebook to a type of seabed: replace its least used tiles by tiles from a set of images.

1. Each image is cut into tiles four times: from its corner and shifted by half a tile, plain and mirrored (port and
   starboard shadows point in opposite directions). This doubles the gain.
2. Every training tile is encoded with the base codebook, and the uses of each base tile are counted. The least used
   base tiles are removed (among equals the last); free places up to `max_tiles` are filled first. At least `keep` base
   tiles stay, the most used ones. They keep their numbers and pixels.
3. New tiles are selected from the training tiles in eight steps. Each step sums the squared distances of all training
   tiles to their nearest tile in order, and selects the tiles at which the sum passes equal steps. Tiles with a large
   error are therefore more likely, without random numbers (k-means++ seeding, Arthur and Vassilvitskii, SODA 2007, with
   several tiles a step as in k-means||, Bahmani et al., VLDB 2012, and systematic sampling).
4. Each new tile is moved to the mean of the training tiles nearest to it, `passes` times.
5. New tiles get the numbers of the removed ones. A new tile that became equal to another tile is dropped, and the base
   tile it would have replaced stays. The basis is computed again from all tiles.

Images are loaded each time they are needed. Memory holds tiles and one number for each training tile.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from research.codebook.basis import database_of
from research.codebook.builder import MAX_TILES, TrainingImage, figure_of_merit, refine_once
from research.codebook.tile_set import IncrementalTileSet
from research.common.quality import psnr_db
from sonarpost.codec.interface import Image
from sonarpost.codec.vq.tiles import TileDatabase, Tiles, cut_tiles, join_tiles
from sonarpost.errors import ConfigError

_STEPS = 8
MAX_PSNR_DB = 99.0
"""Replaces the infinite PSNR of an exact reconstruction, so that means stay finite."""
_MAX_SQUARED_DISTANCE = np.int64(1 << 27)
"""Larger than the squared distance of any two tiles of 32 x 32 px. Used while no tile is stored."""

SquaredDistances = npt.NDArray[np.int64]
Progress = Callable[[str, int, int], None]
"""Called with the name of a step, the amount done and the total amount."""


@dataclass(frozen=True)
class AdaptedCodebook:
    """An adapted codebook.

    Attributes:
        tiles: The database.
        used: Number of base tiles that the training images use.
        replaced: Number of base tiles replaced.
        new: Number of tiles selected from the training images.
    """

    tiles: TileDatabase
    used: int
    replaced: int
    new: int


@dataclass(frozen=True)
class CodebookQuality:
    """Quality of one image reconstructed with a codebook: PSNR in dB, and the figure of merit."""

    psnr_db: float
    fom: float


def adapt(
    base: TileDatabase,
    images: Sequence[TrainingImage],
    *,
    max_tiles: int = MAX_TILES,
    keep: int | None = None,
    passes: int = 4,
    progress: Progress | None = None,
) -> AdaptedCodebook:
    """Adapt a codebook (module docstring). The same base and images in the same order give the same codebook.

    Args:
        base: The codebook to adapt.
        images: Images of the seabed.
        max_tiles: Maximum size of the result, at least the size of the base.
        keep: Minimum number of base tiles that stay; None: half of them.
        passes: Refinement passes over the new tiles.
        progress: Receives the progress.

    Raises:
        ConfigError: No images, or a number out of range.
    """
    keep = len(base) // 2 if keep is None else keep
    _check(base, images, max_tiles, keep)
    progress = progress or (lambda step, done, total: None)
    images = _views(images, base.tile_px)
    uses = _uses(base, images, progress)
    free = max_tiles - len(base)
    by_use = np.lexsort((-np.arange(len(base)), uses))  # least used first, among equals the last
    available = sum(cut_tiles(image.load(), base.tile_px).shape[0] for image in images)
    removed = by_use[: max(0, min(free + len(base) - keep, available) - free)]
    kept = np.setdiff1d(np.arange(len(base)), removed)
    tile_set = IncrementalTileSet(base.tile_px, max_tiles)
    tile_set.append(base.tiles[kept])
    _select(tile_set, images, free + removed.size, progress)
    new = _refined(tile_set.tiles(), kept.size, base.tile_px, images, passes, progress)
    places = np.sort(removed)
    tiles = np.concatenate((base.tiles, new[places.size :]))
    tiles[places[: new.shape[0]]] = new[: places.size]
    adapted = database_of(base.tile_px, tiles, base.dims)
    replaced = int((tiles[: len(base)] != base.tiles).any(axis=1).sum())
    return AdaptedCodebook(adapted, int((uses > 0).sum()), replaced, new.shape[0])


def split_images(images: Sequence[TrainingImage]) -> tuple[list[TrainingImage], list[TrainingImage]]:
    """Split into training images and test images. The test images are the last quarter, at least one.

    Neighbours in a folder often show the same piece of seabed, so the test images are consecutive.

    Raises:
        ConfigError: Fewer than two images.
    """
    if len(images) < 2:
        raise ConfigError("codebook adaptation", "images", len(images), "at least 2, for training and for test")
    held_out = max(1, len(images) // 4)
    return list(images[:-held_out]), list(images[-held_out:])


def measure(database: TileDatabase, images: Sequence[TrainingImage]) -> list[CodebookQuality]:
    """Reconstruct each image from the tiles that the codec chooses, and measure the quality."""
    qualities = []
    for image in images:
        pixels = image.load()
        index, _ = database.nearest(cut_tiles(pixels, database.tile_px))
        decoded = join_tiles(database.tiles[index], pixels.shape[0], pixels.shape[1], database.tile_px)
        psnr = min(psnr_db(pixels, decoded), MAX_PSNR_DB)
        qualities.append(CodebookQuality(psnr, figure_of_merit(pixels, decoded)))
    return qualities


def _check(base: TileDatabase, images: Sequence[TrainingImage], max_tiles: int, keep: int) -> None:
    where = "codebook adaptation"
    if not images:
        raise ConfigError(where, "images", 0, "at least one image")
    if max_tiles < len(base):
        raise ConfigError(where, "max_tiles", max_tiles, f"at least {len(base)}, the tiles of the base")
    if not 0 <= keep <= len(base):
        raise ConfigError(where, "keep", keep, f"0..{len(base)}, the tiles of the base")


def _views(images: Sequence[TrainingImage], tile_px: int) -> list[TrainingImage]:
    """Return the four views of each image (step 1 of the module docstring). Small images are not shifted."""

    def view(image: TrainingImage, shift_px: int, step: int) -> TrainingImage:
        def load() -> Image:
            pixels = image.load()
            first = shift_px if min(pixels.shape) > shift_px else 0
            return np.ascontiguousarray(pixels[first:, first:][:, ::step])

        return TrainingImage(image.name, load)

    return [view(image, shift, step) for image in images for shift in (0, tile_px // 2) for step in (1, -1)]


def _uses(base: TileDatabase, images: Sequence[TrainingImage], progress: Progress) -> npt.NDArray[np.int64]:
    uses = np.zeros(len(base), dtype=np.int64)
    for done, image in enumerate(images, 1):
        index, _ = base.nearest(cut_tiles(image.load(), base.tile_px))
        uses += np.bincount(index, minlength=len(base))
        progress("counting uses", done, len(images))
    return uses


def _select(tile_set: IncrementalTileSet, images: Sequence[TrainingImage], count: int, progress: Progress) -> None:
    """Add `count` training tiles to the set, or fewer if there are fewer different ones."""
    before = len(tile_set)
    squared = _squared_distances(tile_set, images, None)
    for step in range(_STEPS):
        left = count - (len(tile_set) - before)
        selected = _systematic_sample(squared, -(-left // (_STEPS - step)))
        if selected.size == 0:
            break
        start = len(tile_set)
        # Tiles selected in one step may be equal: only the first of them is added.
        tiles = _tiles_at(images, tile_set.tile_px, selected)
        tile_set.add_far(tiles, squared[selected].astype(np.float64), 0.0)
        added = IncrementalTileSet(tile_set.tile_px, len(tile_set) - start)
        added.append(tile_set.tiles_at(np.arange(start, len(tile_set))))
        squared = _squared_distances(added, images, squared)
        progress("selecting tiles", step + 1, _STEPS)


def _squared_distances(
    tile_set: IncrementalTileSet, images: Sequence[TrainingImage], known: SquaredDistances | None
) -> SquaredDistances:
    """Return the squared distance of each training tile to the nearest tile of the set, at most the `known` one."""
    parts = []
    start = 0
    for image in images:
        tiles = cut_tiles(image.load(), tile_set.tile_px)
        if len(tile_set):
            squared = tile_set.nearest(tiles)[1].astype(np.int64)
        else:
            squared = np.full(len(tiles), _MAX_SQUARED_DISTANCE)
        parts.append(squared if known is None else np.minimum(squared, known[start : start + squared.size]))
        start += squared.size
    return np.concatenate(parts)


def _systematic_sample(squared: SquaredDistances, count: int) -> npt.NDArray[np.int64]:
    """Return the places, ascending, at which the running sum of `squared` passes the middles of `count` equal parts."""
    running = np.cumsum(squared)
    total = int(running[-1])
    if total == 0 or count < 1:
        return np.empty(0, dtype=np.int64)
    middles = [(2 * part + 1) * total // (2 * count) for part in range(count)]
    return np.unique(np.searchsorted(running, np.array(middles, dtype=np.int64), side="right"))


def _tiles_at(images: Sequence[TrainingImage], tile_px: int, places: npt.NDArray[np.int64]) -> Tiles:
    """Return the training tiles at these places, counted over all images."""
    found = []
    start = 0
    for image in images:
        tiles = cut_tiles(image.load(), tile_px)
        here = places[(places >= start) & (places < start + tiles.shape[0])]
        found.append(tiles[here - start])
        start += tiles.shape[0]
    return np.concatenate(found)


def _refined(
    tiles: Tiles, fixed: int, tile_px: int, images: Sequence[TrainingImage], passes: int, progress: Progress
) -> Tiles:
    """Refine all tiles after the first `fixed`; return the refined ones without duplicates."""
    tiles = tiles.copy()
    for number in range(passes):
        tiles[fixed:] = refine_once(tiles, tile_px, images).tiles[fixed:]
        progress("refining", number + 1, passes)
    _, first = np.unique(tiles, axis=0, return_index=True)
    return tiles[np.sort(first[first >= fixed])]
