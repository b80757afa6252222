"""Build a tile database from images: the paper's Table IV, in rounds.

The first image's tiles all go in. Every further image is rebuilt with the tiles there are so far; where its figure of
merit is below the round's threshold, each of its tiles that lies farther than the round's distance from its nearest
tile is added, one after the other, so a tile just added counts for the next. Exact duplicates are never added.

Distances here are Euclidean in **all** pixels of a tile, not in the principal components: the components are those of
the finished database, so they cannot be known while it grows, and the threshold has a meaning in grey levels. The
paper's 320 is for 400-pixel tiles: 16 grey levels RMS; `rms_distance` gives the same for any tile. The basis that the
encoder searches in is computed once, at the end, from all tiles.

Memory does not grow with the number of images: one is held at a time. Besides the libraries a build takes at most
16 MB, 40 bytes for each pixel of the tiles there may be, and 100 bytes for each pixel of the largest image (a test
holds it to that).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarpost.codec.quality import FigureOfMerit, fom
from sonarpost.codec.vq.build_journal import EntryKind, Journal, JournalEntry
from sonarpost.codec.vq.incremental import IncrementalTileSet
from sonarpost.codec.vq.refinement import refine_once, without_duplicates
from sonarpost.codec.vq.tiles import TileDatabase, Tiles, cut_tiles, join_tiles
from sonarpost.codec.vq.training_config import (
    MAX_TILES,
    BuildProgress,
    RefinementProgress,
    Round,
    TrainingImage,
    check_plan,
    fingerprint,
    images_hash,
    pixels_hash,
    spread,
)
from sonarpost.errors import CodebookError

ProgressCallback = Callable[[BuildProgress | RefinementProgress], None]


def build(
    images: Sequence[TrainingImage],
    tile_px: int,
    rounds: Sequence[Round],
    *,
    max_tiles: int = MAX_TILES,
    dims: int = 70,
    core: TileDatabase | None = None,
    passes: int = 0,
    journal_path: Path | None = None,
    figure_of_merit: FigureOfMerit = fom,
    progress: ProgressCallback | None = None,
) -> TileDatabase:
    """Build a database (module docstring). The same images in the same order give the same database.

    Args:
        images: What to learn from, in order; the first one's tiles all go in unless `core` is given.
        tile_px: Side of a tile, 4..32 px.
        rounds: Passes over the images, in order.
        max_tiles: Rounds end when this many tiles are in.
        dims: Dimensions of the encoder's search space, 1..70.
        core: A finished database to add to (Table IV's "database core is not empty").
        passes: Passes of refinement afterwards (module `refine`).
        journal_path: Where every image's tiles, and every pass, are written as soon as they are known. If the file
            exists, the build goes on from it, so a build that was killed loses at most the image or pass it was
            working on. Images whose pixels are no longer those the journal was written with are refused.
        figure_of_merit: Takes original and rebuilt picture; larger is better.
        progress: Called after every image that was worked on in this run, and during refinement.

    Raises:
        ConfigError: No images, no rounds, or a number out of range.
        CodebookError: The journal belongs to another build or to other pixels, or cannot be read or written.
    """
    check_plan(images, tile_px, rounds, max_tiles, core)
    plan = fingerprint(images, tile_px, rounds, max_tiles, core)
    with Journal(journal_path, plan, tile_px * tile_px) as journal:
        work = _Build(images, tile_px, journal, progress or _untold)
        work.start(IncrementalTileSet(tile_px, max_tiles), core)
        work.run_rounds(rounds, figure_of_merit)
        tiles = work.growing.tiles()
        for number in range(1, passes + 1):
            tiles = work.run_pass(tiles, number, passes)
    return TileDatabase.from_tiles(tile_px, without_duplicates(tiles) if passes else tiles, dims)


def _untold(_: BuildProgress | RefinementProgress) -> None:
    """Stand in for a listener."""


@dataclass
class _Build:
    """A build at work: what is done, and where it is written down."""

    images: Sequence[TrainingImage]
    tile_px: int
    journal: Journal
    told: ProgressCallback
    done: set[tuple[int, int]] = field(default_factory=set)
    hashes: dict[int, bytes] = field(default_factory=dict)
    growing: IncrementalTileSet = field(init=False)
    _all_hash: bytes = b""

    def start(self, growing: IncrementalTileSet, core: TileDatabase | None) -> None:
        """Fill `growing` with the core and with what the journal holds, after a look at the images it came from."""
        self.growing = growing
        if core is not None:
            growing.append(core.tiles)
        for entry in self.journal.entries():
            if entry.kind is EntryKind.IMAGE:
                if entry.image_number >= len(self.images):
                    expected = f"below {len(self.images)}, the number of images"
                    raise CodebookError(self.journal.name, "image", entry.image_number, expected)
                self._load(entry.image_number, entry.pixels_hash)
                growing.append(entry.tiles)
                self.done.add((entry.number, entry.image_number))

    def run_rounds(self, rounds: Sequence[Round], figure_of_merit: FigureOfMerit) -> None:
        """Do what is not done yet of Table IV."""
        for number, settings in enumerate(rounds):
            chosen = spread(len(self.images), settings.max_images)
            for position, image_number in enumerate(chosen, 1):
                if self.growing.full or (number, image_number) in self.done:
                    continue
                pixels = self._load(image_number)
                merit, added = _learn(self.growing, pixels, settings, figure_of_merit)
                record = JournalEntry(EntryKind.IMAGE, number, image_number, self.hashes[image_number], added)
                self.journal.append(record)
                where = (number, len(rounds), image_number, position, len(chosen), self.images[image_number].name)
                self.told(BuildProgress(*where, merit, added.shape[0], len(self.growing)))

    def run_pass(self, tiles: Tiles, number: int, passes: int) -> Tiles:
        """Do one pass of refinement, or take its result from the journal."""
        for entry in self.journal.entries():
            if (entry.kind, entry.number) == (EntryKind.PASS, number):
                self._check_all(entry.pixels_hash)
                return entry.tiles
        count = len(self.images)

        def told(done: int) -> None:
            self.told(RefinementProgress(number, passes, done, count, float("nan")))

        refined = refine_once(tiles, self.tile_px, self.images, told)
        self.journal.append(JournalEntry(EntryKind.PASS, number, 0, refined.images_hash, refined.tiles))
        self.told(RefinementProgress(number, passes, count, count, refined.rms))
        return refined.tiles

    def _load(self, number: int, expected: bytes | None = None) -> npt.NDArray[np.uint8]:
        """Return an image's pixels, if they are those that were met before.

        Raises:
            CodebookError: They are others: what was learned from the image is not in it any more.
        """
        pixels = self.images[number].load()
        met = pixels_hash(pixels)
        known = self.hashes.setdefault(number, expected or met)
        if met != known:
            wanted = f"sha256 {known.hex()}, as when it was learned from (remove the journal to start anew)"
            raise CodebookError(self.images[number].name, "pixels", met.hex(), wanted)
        return pixels

    def _check_all(self, expected: bytes) -> None:
        if not self._all_hash:
            self._all_hash = images_hash(self.images)
        if self._all_hash != expected:
            what = "images as they were when the pass was done (remove the journal to start anew)"
            raise CodebookError(self.journal.name, "pass", self._all_hash.hex(), what)


def _learn(
    growing: IncrementalTileSet, image: npt.NDArray[np.uint8], settings: Round, figure_of_merit: FigureOfMerit
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
