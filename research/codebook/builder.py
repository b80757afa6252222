"""Build a tile database from images: the paper's Table IV, in rounds, with optional refinement.

Table IV: all tiles of the first image are added. Every further image is reconstructed from the tiles stored so far. If
its figure of merit is below the round's threshold, each of its tiles farther than the round's distance from the nearest
stored tile is added, one after the other: a tile just added counts for the next. Exact duplicates are never added.

Distances are Euclidean over all pixels of a tile, not over principal components, which are known only at the end. The
paper's threshold of 320 is for 400-pixel tiles: 16 grey levels RMS. `rms_distance` converts it to other tiles.

Refinement: one pass assigns every training tile to the nearest database tile and replaces each database tile by the
rounded mean of its training tiles (the Linde-Buzo-Gray step of vector quantiser design, IEEE Trans. Communications
28(1), 1980). The squared error over the training tiles cannot increase, except by rounding. Database tiles without
training tiles do not change. Table IV alone depends on the order of similar tiles of speckle; refinement reduces that.

Memory does not depend on the number of images: one is held at a time. A build needs at most 16 MB, 40 bytes for each
pixel of the maximum number of tiles, and 100 bytes for each pixel of the largest image, plus the libraries.
"""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from research.codebook.basis import database_of
from research.codebook.build_journal import BuildEntry, BuildJournal, EntryKind
from research.codebook.tile_set import IncrementalTileSet
from research.common.quality import ssim
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.interface import Image
from sonarpost.codec.vq.tiles import MAX_DIMS, MAX_TILE_PX, MIN_TILE_PX, TileDatabase, Tiles, cut_tiles, join_tiles
from sonarpost.errors import CodebookError, ConfigError

MAX_TILES = 15_992
"""Size of the paper's database. Wire indices up to this number fit 14 bits."""
_BATCH_TILES = 4096

FigureOfMerit = Callable[[Image, Image], float]
"""Takes the original and the reconstructed image (same shape, uint8). Larger is better, 100 is perfect."""


@dataclass(frozen=True)
class TrainingImage:
    """An image to learn from.

    Attributes:
        name: Name in messages and in the fingerprint of the build.
        load: Returns the pixels, shape (height, width), uint8. Called each time they are needed.
    """

    name: str
    load: Callable[[], Image]


@dataclass(frozen=True)
class Round:
    """One pass of Table IV over the images.

    Attributes:
        fom_below: Images reconstructed with a figure of merit below this contribute tiles.
        distance_above: Only tiles farther than this from their nearest stored tile are added.
        max_images: Maximum number of images, spread evenly over the list; None: all.
    """

    fom_below: float
    distance_above: float
    max_images: int | None = None


@dataclass(frozen=True)
class BuildProgress:
    """Progress of a build after an image.

    Attributes:
        round_number: From 0.
        rounds: Number of rounds.
        image_number: Position in the list of images, from 0.
        done_in_round: Images of this round that are done, including those of an interrupted run.
        images_in_round: Images of this round.
        tiles: Tiles stored now.
    """

    round_number: int
    rounds: int
    image_number: int
    done_in_round: int
    images_in_round: int
    tiles: int

    def show_on(self, display: ProgressDisplay) -> None:
        """Show this progress."""
        step = f"round {self.round_number + 1} of {self.rounds}"
        display.show(step, self.done_in_round, self.images_in_round, f"{self.tiles} tiles")


@dataclass(frozen=True)
class RefinementProgress:
    """Progress of a refinement pass after a batch of images, and at its end.

    Attributes:
        pass_number: From 1.
        passes: Number of passes.
        done_images: Images of this pass that are done.
        images: Images of this pass.
        rms: Error of the tiles before the pass, grey levels RMS over all training tiles; NaN before the end.
    """

    pass_number: int
    passes: int
    done_images: int
    images: int
    rms: float

    def show_on(self, display: ProgressDisplay) -> None:
        """Show this progress, and at the end of the pass the error."""
        step = f"refining {self.pass_number} of {self.passes}"
        if math.isnan(self.rms):
            display.show(step, self.done_images, self.images)
        else:
            display.line(f"{step}: the error was {self.rms:.2f} grey levels RMS before")


@dataclass(frozen=True)
class RefinedTiles:
    """Result of a refinement pass.

    Attributes:
        tiles: Shape (n, pixels): the means.
        rms: Error of the tiles before the pass, grey levels RMS over all training tiles.
        images_hash: SHA-256 over the pixel hashes of all images, in order.
    """

    tiles: Tiles
    rms: float
    images_hash: bytes


ProgressCallback = Callable[[BuildProgress | RefinementProgress], None]


def rms_distance(grey_levels: float, tile_px: int) -> float:
    """Return the distance of two tiles that differ by `grey_levels` RMS (16 at 20 px is the paper's 320)."""
    return grey_levels * tile_px


def figure_of_merit(original: Image, reconstructed: Image) -> float:
    """Return the default figure of merit: 100 times the mean SSIM, 100 for equal images and 0 for unrelated ones.

    The paper leaves the figure of merit to the user and gives the threshold 39. SSIM measures structure (highlight,
    shadow, texture), which operators evaluate; PSNR hardly measures it on speckle.
    """
    return 100.0 * ssim(original, reconstructed)


def build(
    images: Sequence[TrainingImage],
    tile_px: int,
    rounds: Sequence[Round],
    *,
    max_tiles: int = MAX_TILES,
    dims: int = MAX_DIMS,
    core: TileDatabase | None = None,
    passes: int = 0,
    journal_path: Path | None = None,
    merit: FigureOfMerit = figure_of_merit,
    progress: ProgressCallback | None = None,
) -> TileDatabase:
    """Build a database. The same images in the same order give the same database.

    Args:
        images: Training images, in order. Without `core`, all tiles of the first one are added.
        tile_px: Side of a tile, 4..32 px.
        rounds: Passes of Table IV, in order.
        max_tiles: Number of tiles at which the rounds end.
        dims: Dimensions of the basis, 1..70.
        core: A database to extend (Table IV: "database core is not empty").
        passes: Refinement passes after the rounds.
        journal_path: File for the result of every image and pass, written at once. If it exists, the build resumes, so
            an interrupted build loses one image or pass at most. Images with changed pixels are rejected.
        merit: Figure of merit.
        progress: Called after every image processed in this run, and during refinement.

    Raises:
        ConfigError: No images, no rounds, or a number out of range.
        CodebookError: The journal belongs to another build or to other pixels, or cannot be read or written.
    """
    _check_arguments(images, tile_px, rounds, max_tiles, core)
    fingerprint = build_fingerprint(images, tile_px, rounds, max_tiles, core)
    with BuildJournal(journal_path, fingerprint, tile_px * tile_px) as journal:
        run = _BuildRun(images, tile_px, journal, progress or (lambda _: None), IncrementalTileSet(tile_px, max_tiles))
        run.restore(core)
        run.run_rounds(rounds, merit)
        tiles = run.tile_set.tiles()
        for number in range(1, passes + 1):
            tiles = run.run_pass(tiles, number, passes)
    return database_of(tile_px, without_duplicates(tiles) if passes else tiles, dims)


@dataclass
class _BuildRun:
    """A running build: the tiles so far, the completed images, and the journal."""

    images: Sequence[TrainingImage]
    tile_px: int
    journal: BuildJournal
    progress: ProgressCallback
    tile_set: IncrementalTileSet
    completed: set[tuple[int, int]] = field(default_factory=set)
    hashes: dict[int, bytes] = field(default_factory=dict)
    _images_hash: bytes = b""

    def restore(self, core: TileDatabase | None) -> None:
        """Add the tiles of the core and of the journal, and verify the images of the journal."""
        if core is not None:
            self.tile_set.append(core.tiles)
        for entry in self.journal.entries():
            if entry.kind is EntryKind.IMAGE:
                if entry.image_number >= len(self.images):
                    expected = f"below {len(self.images)}, the number of images"
                    raise CodebookError(self.journal.name, "image", entry.image_number, expected)
                self._load(entry.image_number, entry.pixels_hash)
                self.tile_set.append(entry.tiles)
                self.completed.add((entry.number, entry.image_number))

    def run_rounds(self, rounds: Sequence[Round], merit: FigureOfMerit) -> None:
        """Process the images of all rounds that the journal does not hold."""
        for number, settings in enumerate(rounds):
            chosen = evenly_spaced(len(self.images), settings.max_images)
            for position, image_number in enumerate(chosen, 1):
                if self.tile_set.full or (number, image_number) in self.completed:
                    continue
                added = _learn(self.tile_set, self._load(image_number), settings, merit)
                entry = BuildEntry(EntryKind.IMAGE, number, image_number, self.hashes[image_number], added)
                self.journal.append(entry)
                place = (number, len(rounds), image_number, position, len(chosen))
                self.progress(BuildProgress(*place, len(self.tile_set)))

    def run_pass(self, tiles: Tiles, number: int, passes: int) -> Tiles:
        """Run one refinement pass, or return its result from the journal."""
        for entry in self.journal.entries():
            if (entry.kind, entry.number) == (EntryKind.PASS, number):
                self._check_all_images(entry.pixels_hash)
                return entry.tiles
        count = len(self.images)

        def report(done: int) -> None:
            self.progress(RefinementProgress(number, passes, done, count, math.nan))

        refined = refine_once(tiles, self.tile_px, self.images, report)
        self.journal.append(BuildEntry(EntryKind.PASS, number, 0, refined.images_hash, refined.tiles))
        self.progress(RefinementProgress(number, passes, count, count, refined.rms))
        return refined.tiles

    def _load(self, number: int, expected: bytes | None = None) -> Image:
        """Return the pixels of an image.

        Raises:
            CodebookError: They have changed since the image was processed.
        """
        pixels = self.images[number].load()
        actual = _pixels_hash(pixels)
        known = self.hashes.setdefault(number, expected or actual)
        if actual != known:
            wanted = f"sha256 {known.hex()}, as when the image was processed (remove the journal to start over)"
            raise CodebookError(self.images[number].name, "pixels", actual.hex(), wanted)
        return pixels

    def _check_all_images(self, expected: bytes) -> None:
        if not self._images_hash:
            digest = hashlib.sha256()
            for image in self.images:
                digest.update(_pixels_hash(image.load()))
            self._images_hash = digest.digest()
        if self._images_hash != expected:
            wanted = "images unchanged since the refinement pass (remove the journal to start over)"
            raise CodebookError(self.journal.name, "pass", self._images_hash.hex(), wanted)


def _learn(tile_set: IncrementalTileSet, image: Image, settings: Round, merit: FigureOfMerit) -> Tiles:
    """Apply Table IV to one image; return the added tiles."""
    tiles = cut_tiles(image, tile_set.tile_px)
    if len(tile_set) == 0:
        return tile_set.add_far(tiles, np.full(tiles.shape[0], np.inf), 0.0)
    index, squared = tile_set.nearest(tiles)
    reconstructed = join_tiles(tile_set.tiles_at(index), image.shape[0], image.shape[1], tile_set.tile_px)
    if merit(image, reconstructed) >= settings.fom_below:
        return tiles[:0]
    return tile_set.add_far(tiles, squared, settings.distance_above)


def refine_once(
    tiles: Tiles, tile_px: int, images: Sequence[TrainingImage], progress: Callable[[int], None] | None = None
) -> RefinedTiles:
    """Run one refinement pass (module docstring).

    Args:
        tiles: Shape (n, pixels).
        tile_px: Side of a tile.
        images: The training images. One batch of their tiles is held at a time.
        progress: Called after each batch with the number of images done.
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
        if progress is not None:
            progress(done)
    used = counts > 0
    means = tiles.copy()
    means[used] = ((2 * sums[used] + counts[used, None]) // (2 * counts[used, None])).astype(np.uint8)
    pixels = max(int(counts.sum()), 1) * tile_px * tile_px
    return RefinedTiles(means, float(np.sqrt(squared_error / pixels)), digest.digest())


def _batches(
    images: Sequence[TrainingImage], tile_px: int, add_hash: Callable[[bytes], None]
) -> Iterator[tuple[Tiles, int]]:
    """Yield the tiles of several images at a time, with the number of images done."""
    batch: list[Tiles] = []
    for number, image in enumerate(images, 1):
        pixels = image.load()
        add_hash(_pixels_hash(pixels))
        batch.append(cut_tiles(pixels, tile_px))
        if sum(tiles.shape[0] for tiles in batch) >= _BATCH_TILES:
            yield np.concatenate(batch), number
            batch = []
    if batch:
        yield np.concatenate(batch), len(images)


def without_duplicates(tiles: Tiles) -> Tiles:
    """Return each tile once, in order. Refined tiles may coincide, and a duplicate would waste an index."""
    _, first = np.unique(tiles, axis=0, return_index=True)
    return tiles[np.sort(first)]


def evenly_spaced(available: int, count: int | None) -> tuple[int, ...]:
    """Return at most `count` of the numbers 0..available-1, evenly spaced from 0; None: all."""
    if count is None or count >= available:
        return tuple(range(available))
    return tuple(i * available // count for i in range(count))


def _pixels_hash(pixels: Image) -> bytes:
    """Return the SHA-256 of an image's size and pixels."""
    digest = hashlib.sha256(f"{pixels.shape[0]} {pixels.shape[1]}\n".encode())
    digest.update(np.ascontiguousarray(pixels).data)
    return digest.digest()


def build_fingerprint(
    images: Sequence[TrainingImage], tile_px: int, rounds: Sequence[Round], max_tiles: int, core: TileDatabase | None
) -> str:
    """Return the arguments that a resumed build must share with the interrupted one, as text, without pixels."""
    lines = [f"tile_px {tile_px}", f"max_tiles {max_tiles}", f"core {core.identity if core is not None else 'none'}"]
    lines += [f"round {r.fom_below!r} {r.distance_above!r} {r.max_images!r}" for r in rounds]
    lines += [f"image {image.name}" for image in images]
    return "\n".join(lines)


def _check_arguments(
    images: Sequence[TrainingImage], tile_px: int, rounds: Sequence[Round], max_tiles: int, core: TileDatabase | None
) -> None:
    def check(field_name: str, value: object, expected: str, *, is_valid: bool) -> None:
        if not is_valid:
            raise ConfigError("codebook build", field_name, value, expected)

    check("images", 0, "at least one image", is_valid=bool(images))
    check("rounds", 0, "at least one round", is_valid=bool(rounds))
    check("tile_px", tile_px, f"{MIN_TILE_PX}..{MAX_TILE_PX} px", is_valid=MIN_TILE_PX <= tile_px <= MAX_TILE_PX)
    for number, settings in enumerate(rounds):
        name, most = f"rounds[{number}]", settings.max_images
        distance = settings.distance_above
        check(f"{name}.distance_above", distance, "zero or more", is_valid=distance >= 0)
        check(f"{name}.max_images", most, "at least 1, or none for all", is_valid=most is None or most >= 1)
    if core is not None:
        expected = f"{tile_px}, the tile size of this build"
        check("core.tile_px", core.tile_px, expected, is_valid=core.tile_px == tile_px)
    least = 1 if core is None else len(core)
    check("max_tiles", max_tiles, f"at least {least}, the tiles of the core or 1", is_valid=max_tiles >= least)
