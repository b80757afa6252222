"""Builds that were stopped, images that changed meanwhile, and memory that must not grow with the images."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from sonarpost.codec.vq.build_journal import EntryKind, Journal, JournalEntry
from sonarpost.codec.vq.builder import build
from sonarpost.codec.vq.incremental import IncrementalTileSet
from sonarpost.codec.vq.training_config import (
    BuildProgress,
    RefinementProgress,
    Round,
    TrainingImage,
    fingerprint,
    rms_distance,
)
from sonarpost.errors import CodebookError

ROUNDS = (Round(1e9, rms_distance(45, 8)), Round(1e9, rms_distance(40, 8), 4))
CHANGED = "remove the journal to start anew"


class Killed(BaseException):
    """Stands for the process being killed."""


def image(seed: int, side_px: int = 40) -> np.ndarray:
    return np.clip(50 * np.random.default_rng(seed).rayleigh(1.0, (side_px, side_px)), 0, 255).astype(np.uint8)


class Folder:
    """Images that may change, and a count of how often each is read."""

    def __init__(self, count: int) -> None:
        self.pixels = [image(seed) for seed in range(count)]
        self.reads = [0] * count

    def images(self) -> list[TrainingImage]:
        return [TrainingImage(f"image {i}", lambda i=i: self._load(i)) for i in range(len(self.pixels))]

    def _load(self, number: int) -> np.ndarray:
        self.reads[number] += 1
        return self.pixels[number]


def run_until(folder: Folder, journal: Path, passes: int, stop: int) -> None:
    """Build until `stop` records are written, then die."""
    written = [0]

    def told(progress: BuildProgress | RefinementProgress) -> None:
        # A pass tells of its images before its record is written, and of its error when it is.
        if isinstance(progress, BuildProgress) or not np.isnan(progress.rms):
            written[0] += 1
            if written[0] == stop:
                raise Killed

    with pytest.raises(Killed):
        build(folder.images(), 8, ROUNDS, passes=passes, journal_path=journal, progress=told)


@pytest.mark.parametrize("stop", [3, 8, 10, 11, 12])
def test_a_build_killed_anywhere_in_rounds_or_refinement_goes_on_to_the_same(tmp_path: Path, stop: int) -> None:
    folder = Folder(6)
    whole = build(folder.images(), 8, ROUNDS, passes=3)
    journal = tmp_path / "journal"
    run_until(folder, journal, 3, stop)
    with Journal(journal, fingerprint(folder.images(), 8, ROUNDS, 15_992, None), 64) as written:
        kinds = [entry.kind for entry in written.entries()]
    assert kinds == [EntryKind.IMAGE] * min(stop, 10) + [EntryKind.PASS] * max(0, stop - 10)
    told: list[BuildProgress | RefinementProgress] = []
    resumed = build(folder.images(), 8, ROUNDS, passes=3, journal_path=journal, progress=told.append)
    assert resumed.identity == whole.identity
    assert len([p for p in told if isinstance(p, BuildProgress)]) == max(0, 10 - stop)
    assert len({p.number for p in told if isinstance(p, RefinementProgress)}) == 3 - max(0, stop - 10)


def test_more_passes_may_be_asked_of_a_finished_journal(tmp_path: Path) -> None:
    folder = Folder(4)
    journal = tmp_path / "journal"
    build(folder.images(), 8, ROUNDS, passes=1, journal_path=journal)
    more = build(folder.images(), 8, ROUNDS, passes=2, journal_path=journal)
    assert more.identity == build(folder.images(), 8, ROUNDS, passes=2).identity
    fewer = build(folder.images(), 8, ROUNDS, passes=0, journal_path=journal)
    assert fewer.identity == build(folder.images(), 8, ROUNDS).identity


def test_an_image_that_changed_since_it_was_learned_from_is_refused_by_name(tmp_path: Path) -> None:
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
    # One turned on its side has the same bytes but is another image.
    folder.pixels[2] = image(2)
    folder.pixels[1] = folder.pixels[1].reshape(20, 80)
    with pytest.raises(CodebookError, match=CHANGED):
        build(folder.images(), 8, ROUNDS, journal_path=journal)
    folder.pixels[1] = image(1)
    folder.pixels[5] = image(77)  # not learned from yet
    assert len(build(folder.images(), 8, ROUNDS, journal_path=journal)) > 0


def test_images_that_changed_since_a_pass_are_refused(tmp_path: Path) -> None:
    folder = Folder(6)
    rounds = (Round(1e9, rms_distance(45, 8), 2),)  # image 5 is only in the refinement
    journal = tmp_path / "journal"
    build(folder.images(), 8, rounds, passes=1, journal_path=journal)
    folder.pixels[5] = image(78)
    with pytest.raises(CodebookError, match="pass"):
        build(folder.images(), 8, rounds, passes=2, journal_path=journal)


def test_an_image_that_changes_between_rounds_is_refused() -> None:
    folder = Folder(4)

    def told(progress: BuildProgress | RefinementProgress) -> None:
        if isinstance(progress, BuildProgress) and (progress.round_number, progress.image_number) == (0, 3):
            folder.pixels[1] = image(79)

    with pytest.raises(CodebookError, match="image 1"):
        build(folder.images(), 8, ROUNDS, progress=told)


def test_a_journal_that_names_an_image_there_is_not_is_refused(tmp_path: Path) -> None:
    folder = Folder(2)
    with Journal(tmp_path / "journal", fingerprint(folder.images(), 8, ROUNDS, 15_992, None), 64) as journal:
        journal.append(JournalEntry(EntryKind.IMAGE, 0, 2, bytes(32), np.zeros((1, 64), np.uint8)))
    with pytest.raises(CodebookError, match="number of images"):
        build(folder.images(), 8, ROUNDS, journal_path=tmp_path / "journal")


def test_a_count_that_asks_for_gigabytes_is_a_torn_record(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    Journal(path, "plan", 64).__exit__(None, None, None)
    start = path.stat().st_size
    path.write_bytes(path.read_bytes() + bytes([0, 0, 0, 0, 0, 0, 0]) + b"\xff" * 4 + bytes(32) + b"xxxx")
    with Journal(path, "plan", 64) as journal:
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


def test_memory_follows_the_tiles_not_the_images(tmp_path: Path) -> None:
    peak_bytes(2, 100, 1)  # what is compiled or cached once does not count
    few, many = peak_bytes(50, 900, 1), peak_bytes(150, 900, 1)
    assert many < few + 300_000  # 1 MB of pixels more, of which none are kept; hashes and names are
    assert peak_bytes(150, 900, 1, tmp_path / "journal") < few + 300_000
    assert peak_bytes(150, 900, 1, tmp_path / "journal") < few + 300_000  # all from the journal


def test_memory_stays_within_what_is_documented() -> None:
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


def test_a_picture_larger_than_any_snippet_is_searched_in_parts() -> None:
    growing = IncrementalTileSet(8, 4096)
    rng = np.random.default_rng(0)
    growing.append(rng.integers(0, 256, (4096, 64), dtype=np.uint8))
    queries = rng.integers(0, 256, (30_000, 64), dtype=np.uint8)
    growing.nearest(queries[:300])
    tracemalloc.start()
    try:
        growing.nearest(queries)
        assert tracemalloc.get_traced_memory()[1] < 12_000_000  # all scores at once would be 490 MB
    finally:
        tracemalloc.stop()


def test_a_picture_of_several_chunks_is_added_tile_by_tile() -> None:
    rng = np.random.default_rng(1)
    tiles = rng.integers(0, 24, (1500, 16), dtype=np.uint8)
    growing = IncrementalTileSet(4, 10_000)
    added = growing.add_far(tiles, np.full(1500, np.inf), 24.0)
    expected: list[np.ndarray] = []
    for tile in tiles.astype(np.int64):
        if all(((tile - other) ** 2).sum() > 24 * 24 for other in expected):
            expected.append(tile)
    assert 300 < len(expected) < 1400
    assert np.array_equal(added, np.array(expected))
    assert np.array_equal(growing.tiles(), added)
