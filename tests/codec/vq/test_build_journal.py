"""Interrupted codebook builds, images that changed since, and the memory of a build."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from sonarpost.codec.vq.build_journal import EntryKind, Journal, JournalEntry
from sonarpost.codec.vq.builder import (
    BuildProgress,
    RefinementProgress,
    Round,
    TrainingImage,
    build,
    build_fingerprint,
    rms_distance,
)
from sonarpost.codec.vq.tile_search import IncrementalTileSet
from sonarpost.errors import CodebookError

ROUNDS = (Round(1e9, rms_distance(45, 8)), Round(1e9, rms_distance(40, 8), 4))
CHANGED = "remove the journal to start over"


class Killed(BaseException):
    """Simulates a killed process."""


def image(seed: int, side_px: int = 40) -> np.ndarray:
    return np.clip(50 * np.random.default_rng(seed).rayleigh(1.0, (side_px, side_px)), 0, 255).astype(np.uint8)


class Folder:
    """Images that may change, with a count of the reads of each."""

    def __init__(self, count: int) -> None:
        self.pixels = [image(seed) for seed in range(count)]
        self.reads = [0] * count

    def images(self) -> list[TrainingImage]:
        return [TrainingImage(f"image {i}", lambda i=i: self._load(i)) for i in range(len(self.pixels))]

    def _load(self, number: int) -> np.ndarray:
        self.reads[number] += 1
        return self.pixels[number]


def run_until(folder: Folder, journal: Path, passes: int, stop: int) -> None:
    """Build until `stop` records are written, then stop."""
    written = [0]

    def on_progress(progress: BuildProgress | RefinementProgress) -> None:
        # A pass reports its images before its record is written, and its error afterwards.
        if isinstance(progress, BuildProgress) or not np.isnan(progress.rms):
            written[0] += 1
            if written[0] == stop:
                raise Killed

    with pytest.raises(Killed):
        build(folder.images(), 8, ROUNDS, passes=passes, journal_path=journal, progress=on_progress)


@pytest.mark.parametrize("stop", [3, 8, 10, 11, 12])
def test_interrupted_rounds_and_refinement_resume_to_the_same_codebook(tmp_path: Path, stop: int) -> None:
    folder = Folder(6)
    uninterrupted = build(folder.images(), 8, ROUNDS, passes=3)
    journal = tmp_path / "journal"
    run_until(folder, journal, 3, stop)
    with Journal(journal, build_fingerprint(folder.images(), 8, ROUNDS, 15_992, None), 64) as written:
        kinds = [entry.kind for entry in written.entries()]
    assert kinds == [EntryKind.IMAGE] * min(stop, 10) + [EntryKind.PASS] * max(0, stop - 10)
    reported: list[BuildProgress | RefinementProgress] = []
    resumed = build(folder.images(), 8, ROUNDS, passes=3, journal_path=journal, progress=reported.append)
    assert resumed.identity == uninterrupted.identity
    assert len([p for p in reported if isinstance(p, BuildProgress)]) == max(0, 10 - stop)
    assert len({p.pass_number for p in reported if isinstance(p, RefinementProgress)}) == 3 - max(0, stop - 10)


def test_finished_journal_allows_more_passes(tmp_path: Path) -> None:
    folder = Folder(4)
    journal = tmp_path / "journal"
    build(folder.images(), 8, ROUNDS, passes=1, journal_path=journal)
    more = build(folder.images(), 8, ROUNDS, passes=2, journal_path=journal)
    assert more.identity == build(folder.images(), 8, ROUNDS, passes=2).identity
    fewer = build(folder.images(), 8, ROUNDS, passes=0, journal_path=journal)
    assert fewer.identity == build(folder.images(), 8, ROUNDS).identity


def test_error_names_an_image_changed_since_it_was_processed(tmp_path: Path) -> None:
    folder = Folder(6)
    journal = tmp_path / "journal"
    run_until(folder, journal, 0, 4)
    before = journal.read_bytes()
    folder.pixels[2] = folder.pixels[2].copy()
    folder.pixels[2][5, 5] ^= 1
    with pytest.raises(CodebookError, match=CHANGED) as caught:
        build(folder.images(), 8, ROUNDS, journal_path=journal)
    assert (caught.value.where, caught.value.field) == ("image 2", "pixels")
    assert journal.read_bytes() == before
    # A reshaped image has the same bytes but is another image.
    folder.pixels[2] = image(2)
    folder.pixels[1] = folder.pixels[1].reshape(20, 80)
    with pytest.raises(CodebookError, match=CHANGED):
        build(folder.images(), 8, ROUNDS, journal_path=journal)
    folder.pixels[1] = image(1)
    folder.pixels[5] = image(77)  # not processed yet
    assert len(build(folder.images(), 8, ROUNDS, journal_path=journal)) > 0


def test_images_changed_since_a_pass_are_rejected(tmp_path: Path) -> None:
    folder = Folder(6)
    rounds = (Round(1e9, rms_distance(45, 8), 2),)  # image 5 takes part in the refinement only
    journal = tmp_path / "journal"
    build(folder.images(), 8, rounds, passes=1, journal_path=journal)
    folder.pixels[5] = image(78)
    with pytest.raises(CodebookError, match="pass"):
        build(folder.images(), 8, rounds, passes=2, journal_path=journal)


def test_image_changed_between_rounds_is_rejected() -> None:
    folder = Folder(4)

    def on_progress(progress: BuildProgress | RefinementProgress) -> None:
        if isinstance(progress, BuildProgress) and (progress.round_number, progress.image_number) == (0, 3):
            folder.pixels[1] = image(79)

    with pytest.raises(CodebookError, match="image 1"):
        build(folder.images(), 8, ROUNDS, progress=on_progress)


def test_journal_with_an_unknown_image_number_is_rejected(tmp_path: Path) -> None:
    folder = Folder(2)
    with Journal(tmp_path / "journal", build_fingerprint(folder.images(), 8, ROUNDS, 15_992, None), 64) as journal:
        journal.append(JournalEntry(EntryKind.IMAGE, 0, 2, bytes(32), np.zeros((1, 64), np.uint8)))
    with pytest.raises(CodebookError, match="number of images"):
        build(folder.images(), 8, ROUNDS, journal_path=tmp_path / "journal")


def test_damaged_tile_count_does_not_allocate_memory(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    Journal(path, "fingerprint", 64).__exit__(None, None, None)
    start = path.stat().st_size
    path.write_bytes(path.read_bytes() + bytes([0, 0, 0, 0, 0, 0, 0]) + b"\xff" * 4 + bytes(32) + b"xxxx")
    with Journal(path, "fingerprint", 64) as journal:
        assert list(journal.entries()) == []
    assert path.stat().st_size == start


def peak_bytes(count: int, max_tiles: int, passes: int, journal: Path | None = None) -> int:
    images = [TrainingImage(f"{i}", lambda i=i: image(i, 100)) for i in range(count)]
    tracemalloc.start()
    try:
        build(images, 10, [Round(1e9, 0.0)], max_tiles=max_tiles, passes=passes, journal_path=journal)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_depends_on_tiles_not_on_images(tmp_path: Path) -> None:
    peak_bytes(2, 100, 1)  # excludes memory for compilation and caches
    few, many = peak_bytes(50, 900, 1), peak_bytes(150, 900, 1)
    assert many < few + 300_000  # 1 MB more pixels, which are not stored; hashes and names are
    assert peak_bytes(150, 900, 1, tmp_path / "journal") < few + 300_000
    assert peak_bytes(150, 900, 1, tmp_path / "journal") < few + 300_000  # all tiles from the journal


def test_memory_is_within_the_documented_limit() -> None:
    peak_bytes(2, 100, 1)
    tiles = 6_000
    assert peak_bytes(70, tiles, 1) < 16_000_000 + 40 * tiles * 100 + 100 * 100 * 100
    large = image(0, 1200)
    images = [TrainingImage("small", lambda: large[:100, :100]), TrainingImage("large", lambda: large)]
    tracemalloc.start()
    try:
        assert len(build(images, 10, [Round(1e9, 300.0)], max_tiles=300, passes=1)) == 300
        assert tracemalloc.get_traced_memory()[1] < 16_000_000 + 40 * 300 * 100 + 100 * large.size
    finally:
        tracemalloc.stop()


def test_large_image_is_searched_in_parts() -> None:
    tile_set = IncrementalTileSet(8, 4096)
    rng = np.random.default_rng(0)
    tile_set.append(rng.integers(0, 256, (4096, 64), dtype=np.uint8))
    queries = rng.integers(0, 256, (30_000, 64), dtype=np.uint8)
    tile_set.nearest(queries[:300])
    tracemalloc.start()
    try:
        tile_set.nearest(queries)
        assert tracemalloc.get_traced_memory()[1] < 12_000_000  # all scores at once would be 490 MB
    finally:
        tracemalloc.stop()


def test_image_of_several_chunks_is_added_tile_by_tile() -> None:
    rng = np.random.default_rng(1)
    tiles = rng.integers(0, 24, (1500, 16), dtype=np.uint8)
    tile_set = IncrementalTileSet(4, 10_000)
    added = tile_set.add_far(tiles, np.full(1500, np.inf), 24.0)
    expected: list[np.ndarray] = []
    for tile in tiles.astype(np.int64):
        if all(((tile - other) ** 2).sum() > 24 * 24 for other in expected):
            expected.append(tile)
    assert 300 < len(expected) < 1400
    assert np.array_equal(added, np.array(expected))
    assert np.array_equal(tile_set.tiles(), added)
