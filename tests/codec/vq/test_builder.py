"""The codebook builder: Table IV, refinement, journal, incremental search."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from sonarpost.codec.vq.build_journal import MAGIC, EntryKind, Journal, JournalEntry
from sonarpost.codec.vq.builder import (
    BuildProgress,
    Round,
    TrainingImage,
    build,
    evenly_spaced,
    figure_of_merit,
    refine_once,
    rms_distance,
    without_duplicates,
)
from sonarpost.codec.vq.tile_search import IncrementalTileSet
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles
from sonarpost.errors import CodebookError, ConfigError

ALWAYS, NEVER = 1e9, -1e9


def image(seed: int, side_px: int = 40, level: float = 50.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.clip(level * rng.rayleigh(1.0, (side_px, side_px)), 0, 255).astype(np.uint8)


def flat(*levels: int, tile_px: int = 8) -> np.ndarray:
    """Return tiles of one grey level each, side by side."""
    return np.concatenate([np.full((tile_px, tile_px), level, np.uint8) for level in levels], axis=1)


def training(*images: np.ndarray) -> list[TrainingImage]:
    return [TrainingImage(f"image {i}", lambda p=p: p) for i, p in enumerate(images)]


def levels(database: TileDatabase) -> list[int]:
    return [int(tile[0]) for tile in database.tiles]


def table_iv(images: list[np.ndarray], tile_px: int, fom_below: float, above: float, merit) -> list[bytes]:
    """Return the tiles of the paper's algorithm, computed tile by tile as a reference."""
    tiles: list[np.ndarray] = []
    for number, image in enumerate(images):
        cut = cut_tiles(image, tile_px)
        if number > 0:
            nearest = [min(tiles, key=lambda t, c=c: int(((t.astype(int) - c) ** 2).sum())) for c in cut]
            rows = -(-image.shape[0] // tile_px)
            blocks = np.stack(nearest).reshape(rows, -1, tile_px, tile_px).swapaxes(1, 2)
            reconstructed = blocks.reshape(rows * tile_px, -1)[: image.shape[0], : image.shape[1]]
            if merit(image, reconstructed) >= fom_below:
                continue
        for candidate in cut:
            squared = min((int(((t.astype(int) - candidate) ** 2).sum()) for t in tiles), default=None)
            limit = 0 if number == 0 else above * above
            if squared is None or squared > limit:
                tiles.append(candidate)
    return [tile.tobytes() for tile in tiles]


@pytest.mark.parametrize("fom_below", [20.0, 45.0, ALWAYS])
@pytest.mark.parametrize("rms", [0.0, 20.0, 45.0])
def test_build_matches_table_iv_tile_by_tile(fom_below: float, rms: float) -> None:
    images = [image(seed, level=15.0 + 20 * (seed % 4)) for seed in range(7)] + [image(99, 37)]
    above = rms_distance(rms, 8)
    database = build(training(*images), 8, [Round(fom_below, above)])
    assert [tile.tobytes() for tile in database.tiles] == table_iv(images, 8, fom_below, above, figure_of_merit)


def test_all_tiles_of_the_first_image_are_added_except_duplicates() -> None:
    database = build(training(flat(10, 11, 10, 200, 11)), 8, [Round(NEVER, 1e6)])
    assert levels(database) == [10, 11, 200]


def test_image_with_a_high_figure_of_merit_adds_nothing() -> None:
    compared = []

    def merit(original: np.ndarray, reconstructed: np.ndarray) -> float:
        compared.append((int(original[0, 0]), int(reconstructed[0, 0])))
        return 39.0 if original[0, 0] == 100 else 38.9

    database = build(training(flat(0), flat(100), flat(200)), 8, [Round(39.0, 0.0)], merit=merit)
    assert levels(database) == [0, 200]
    assert compared == [(100, 0), (200, 0)]


def test_tiles_beyond_the_distance_are_added_one_by_one() -> None:
    # 8 x 8 tiles that differ by d grey levels are 8 d apart.
    database = build(training(flat(0), flat(16, 17, 30, 33, 34)), 8, [Round(ALWAYS, rms_distance(16, 8))])
    assert levels(database) == [0, 17, 34]  # 16 is not farther than 16; 30 and 33 are near the 17 just added
    assert rms_distance(16, 20) == 320  # the value of the paper


def test_rounds_with_fewer_images() -> None:
    reported: list[BuildProgress] = []
    images = [flat(level) for level in (0, 20, 40, 60)]
    rounds = [Round(ALWAYS, rms_distance(50, 8)), Round(ALWAYS, rms_distance(10, 8), 2)]
    database = build(training(*images), 8, rounds, progress=reported.append)
    assert levels(database) == [0, 60, 40]
    assert [(p.round_number, p.image_number, p.tiles) for p in reported] == [
        (0, 0, 1),
        (0, 1, 1),
        (0, 2, 1),
        (0, 3, 2),
        (1, 0, 2),
        (1, 2, 3),
    ]
    assert reported[4].images_in_round == 2


def test_build_stops_at_the_maximum_number_of_tiles() -> None:
    reported: list[BuildProgress] = []
    database = build(
        training(flat(0, 30), flat(60, 90, 120), flat(200)),
        8,
        [Round(ALWAYS, 0.0)],
        max_tiles=4,
        progress=reported.append,
    )
    assert levels(database) == [0, 30, 60, 90]
    assert len(reported) == 2


def test_core_is_extended_and_keeps_its_indices() -> None:
    core = TileDatabase.from_tiles(8, cut_tiles(flat(5, 150), 8))
    database = build(training(flat(6), flat(151, 250)), 8, [Round(ALWAYS, rms_distance(16, 8))], core=core)
    assert levels(database) == [5, 150, 250]


@pytest.mark.parametrize(("available", "count", "numbers"), [(5, None, [0, 1, 2, 3, 4]), (5, 9, [0, 1, 2, 3, 4])])
def test_all_images_are_used_without_a_limit(available: int, count: int | None, numbers: list[int]) -> None:
    assert list(evenly_spaced(available, count)) == numbers


def test_limited_images_are_evenly_spaced_from_the_first() -> None:
    assert evenly_spaced(10, 5) == (0, 2, 4, 6, 8)
    assert evenly_spaced(7, 3) == (0, 2, 4)


def test_same_images_give_the_same_identity() -> None:
    images = training(*[image(seed) for seed in range(5)])
    rounds = [Round(ALWAYS, rms_distance(20, 8))]
    assert build(images, 8, rounds).identity == build(images, 8, rounds).identity
    assert build(images[::-1], 8, rounds).identity != build(images, 8, rounds).identity


class Killed(BaseException):
    """Simulates a killed process."""


@pytest.mark.parametrize("killed_after", [1, 2, 4, 6, 9])
def test_interrupted_rounds_resume_to_the_same_codebook(tmp_path: Path, killed_after: int) -> None:
    images = [image(seed) for seed in range(6)]
    rounds = [Round(ALWAYS, rms_distance(45, 8)), Round(ALWAYS, rms_distance(40, 8), 4)]
    uninterrupted = build(training(*images), 8, rounds)
    journal = tmp_path / "part.journal"
    reported: list[BuildProgress] = []

    def kill(progress: BuildProgress) -> None:
        reported.append(progress)
        if len(reported) == killed_after:
            raise Killed

    with pytest.raises(Killed):
        build(training(*images), 8, rounds, journal_path=journal, progress=kill)
    data = journal.read_bytes()
    for missing in (0, 3):  # the last record complete, and truncated
        journal.write_bytes(data[: len(data) - missing])
        processed: list[BuildProgress] = []
        resumed = build(training(*images), 8, rounds, journal_path=journal, progress=processed.append)
        assert resumed.identity == uninterrupted.identity
        assert len(processed) == 10 - killed_after + (1 if missing else 0)
    again: list[BuildProgress] = []
    assert (
        build(training(*images), 8, rounds, journal_path=journal, progress=again.append).identity
        == uninterrupted.identity
    )
    assert again == []


def test_truncated_or_damaged_journal_keeps_complete_records(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    entries = [JournalEntry(EntryKind.IMAGE, 0, i, bytes(32), np.full((i, 16), i, np.uint8)) for i in range(4)]
    with Journal(path, "fingerprint", 16) as journal:
        for entry in entries:
            journal.append(entry)
    data = path.read_bytes()
    ends = np.cumsum([len(MAGIC) + 32, *(47 + 16 * i for i in range(4))])
    assert ends[-1] == len(data)
    for length in range(len(data) + 1):
        path.write_bytes(data[:length])
        with Journal(path, "fingerprint", 16) as journal:
            complete = [e.image_number for e in journal.entries()]
        assert len(complete) == max(0, int((ends <= length).sum()) - 1)
    for position in range(int(ends[0]), len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x40
        path.write_bytes(damaged)
        with Journal(path, "fingerprint", 16) as journal:
            assert len(list(journal.entries())) == int((ends[1:] <= position).sum())


def test_journal_of_another_build_and_other_files_are_rejected(tmp_path: Path) -> None:
    journal = tmp_path / "part.journal"
    images = training(image(0), image(1))
    build(images, 8, [Round(ALWAYS, 100.0)], journal_path=journal)
    before = journal.read_bytes()
    with pytest.raises(CodebookError, match="fingerprint"):
        build(images, 8, [Round(ALWAYS, 101.0)], journal_path=journal)
    with pytest.raises(CodebookError, match="fingerprint"):
        build(images[::-1], 8, [Round(ALWAYS, 100.0)], journal_path=journal)
    assert journal.read_bytes() == before
    journal.write_bytes(b"some other file of the user")
    with pytest.raises(CodebookError, match="magic"):
        build(images, 8, [Round(ALWAYS, 100.0)], journal_path=journal)
    assert journal.read_bytes() == b"some other file of the user"
    with pytest.raises(CodebookError, match="read and written"):
        build(images, 8, [Round(ALWAYS, 100.0)], journal_path=tmp_path / "absent" / "journal")


@pytest.mark.parametrize(
    ("field", "changes"),
    [
        ("images", {"images": []}),
        ("rounds", {"rounds": []}),
        ("tile_px", {"tile_px": 3}),
        ("rounds[0].distance_above", {"rounds": [Round(1, -1.0)]}),
        ("rounds[0].distance_above", {"rounds": [Round(1, math.nan)]}),
        ("rounds[1].max_images", {"rounds": [Round(1, 1.0), Round(1, 1.0, 0)]}),
        ("max_tiles", {"max_tiles": 0}),
        ("core.tile_px", {"core": TileDatabase.from_tiles(9, np.zeros((1, 81), np.uint8))}),
    ],
)
def test_invalid_arguments_are_rejected(field: str, changes: dict[str, object]) -> None:
    arguments = {"images": training(image(0)), "tile_px": 8, "rounds": [Round(1, 1.0)]} | changes
    with pytest.raises(ConfigError) as caught:
        build(**arguments)
    assert caught.value.field == field


@pytest.mark.parametrize("tile_px", [4, 20, 32])
def test_incremental_search_is_exact(tile_px: int) -> None:
    rng = np.random.default_rng(0)
    tiles = np.where(rng.random((5000, tile_px**2)) < 0.5, rng.integers(0, 256, (5000, tile_px**2)), 255).astype(
        np.uint8
    )
    tile_set = IncrementalTileSet(tile_px, 5000)
    for start in range(0, 5000, 700):
        tile_set.append(tiles[start : start + 700])
    assert np.array_equal(tile_set.tiles(), tiles)
    queries = tiles[::499].copy()
    queries[:, 0] ^= 0xFF
    index, squared = tile_set.nearest(queries)
    for query, found, value in zip(queries, index, squared, strict=True):
        distances = ((tiles.astype(np.int64) - query.astype(np.int64)) ** 2).sum(axis=1)
        assert value == distances.min()
        assert found == np.argmin(distances)


def test_refinement_lowers_the_training_error_and_keeps_the_size() -> None:
    images = training(*[image(seed, 80) for seed in range(6)])
    database = build(images, 8, [Round(ALWAYS, rms_distance(10, 8))], max_tiles=60)
    tiles, errors = database.tiles, []
    for _ in range(4):
        refined = refine_once(tiles, 8, images)
        tiles = refined.tiles
        errors.append(refined.rms)
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > errors[-1]
    assert len(without_duplicates(tiles)) <= len(tiles) == len(database)
    rounds = [Round(ALWAYS, rms_distance(10, 8))]
    assert np.array_equal(build(images, 8, rounds, max_tiles=60, passes=4).tiles, without_duplicates(tiles))


def test_refinement_uses_the_rounded_mean_and_keeps_unused_tiles() -> None:
    database = TileDatabase.from_tiles(8, cut_tiles(flat(10, 100, 250), 8))
    refined = refine_once(database.tiles, 8, training(flat(8, 9, 12, 101, 102)))
    assert refined.tiles[:, 0].tolist() == [10, 102, 250]  # (8 + 9 + 12) / 3 = 9.67; (101 + 102) / 2 = 101.5 rounds up
