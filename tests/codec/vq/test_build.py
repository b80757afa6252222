"""Table IV: what goes into a codebook, in which order, and what a killed build loses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from sonarpost.codec.vq.build_journal import MAGIC, EntryKind, Journal, JournalEntry
from sonarpost.codec.vq.builder import build
from sonarpost.codec.vq.incremental import IncrementalTileSet
from sonarpost.codec.vq.refinement import refine
from sonarpost.codec.vq.tiles import TileDatabase, cut_tiles
from sonarpost.codec.vq.training_config import BuildProgress, Round, TrainingImage, rms_distance, spread
from sonarpost.errors import CodebookError, ConfigError

ALWAYS, NEVER = 1e9, -1e9


def image(seed: int, side_px: int = 40, level: float = 50.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.clip(level * rng.rayleigh(1.0, (side_px, side_px)), 0, 255).astype(np.uint8)


def flat(*levels: int, tile_px: int = 8) -> np.ndarray:
    """Tiles of one grey level each, side by side."""
    return np.concatenate([np.full((tile_px, tile_px), level, np.uint8) for level in levels], axis=1)


def training(*pictures: np.ndarray) -> list[TrainingImage]:
    return [TrainingImage(f"picture {i}", lambda p=p: p) for i, p in enumerate(pictures)]


def levels(database: TileDatabase) -> list[int]:
    return [int(tile[0]) for tile in database.tiles]


def table_iv(pictures: list[np.ndarray], tile_px: int, fom_below: float, above: float, fom) -> list[bytes]:
    """The paper's algorithm, tile by tile in plain Python, as the reference."""
    tiles: list[np.ndarray] = []
    for number, picture in enumerate(pictures):
        cut = cut_tiles(picture, tile_px)
        if number > 0:
            nearest = [min(tiles, key=lambda t, c=c: int(((t.astype(int) - c) ** 2).sum())) for c in cut]
            rows = -(-picture.shape[0] // tile_px)
            blocks = np.stack(nearest).reshape(rows, -1, tile_px, tile_px).swapaxes(1, 2)
            rebuilt = blocks.reshape(rows * tile_px, -1)[: picture.shape[0], : picture.shape[1]]
            if fom(picture, rebuilt) >= fom_below:
                continue
        for candidate in cut:
            squared = min((int(((t.astype(int) - candidate) ** 2).sum()) for t in tiles), default=None)
            limit = 0 if number == 0 else above * above
            if squared is None or squared > limit:
                tiles.append(candidate)
    return [tile.tobytes() for tile in tiles]


@pytest.mark.parametrize("fom_below", [20.0, 45.0, ALWAYS])
@pytest.mark.parametrize("rms", [0.0, 20.0, 45.0])
def test_it_is_table_iv_tile_by_tile(fom_below: float, rms: float) -> None:
    from sonarpost.codec.quality import fom

    pictures = [image(seed, level=15.0 + 20 * (seed % 4)) for seed in range(7)] + [image(99, 37)]
    above = rms_distance(rms, 8)
    database = build(training(*pictures), 8, [Round(fom_below, above)])
    assert [tile.tobytes() for tile in database.tiles] == table_iv(pictures, 8, fom_below, above, fom)


def test_the_first_image_goes_in_whole_but_for_exact_duplicates() -> None:
    database = build(training(flat(10, 11, 10, 200, 11)), 8, [Round(NEVER, 1e6)])
    assert levels(database) == [10, 11, 200]


def test_an_image_that_is_rebuilt_well_adds_nothing() -> None:
    seen = []

    def merit(original: np.ndarray, rebuilt: np.ndarray) -> float:
        seen.append((int(original[0, 0]), int(rebuilt[0, 0])))
        return 39.0 if original[0, 0] == 100 else 38.9

    database = build(training(flat(0), flat(100), flat(200)), 8, [Round(39.0, 0.0)], figure_of_merit=merit)
    assert levels(database) == [0, 200]
    assert seen == [(100, 0), (200, 0)]


def test_only_tiles_farther_than_the_distance_are_added_and_count_at_once() -> None:
    # 8 x 8 tiles that differ by d grey levels are 8 d apart.
    database = build(training(flat(0), flat(16, 17, 30, 33, 34)), 8, [Round(ALWAYS, rms_distance(16, 8))])
    assert levels(database) == [0, 17, 34]  # 16 is not farther than 16; 30 and 33 lie near the 17 just added
    assert rms_distance(16, 20) == 320  # the paper's


def test_rounds_look_again_at_fewer_images() -> None:
    told: list[BuildProgress] = []
    pictures = [flat(level) for level in (0, 20, 40, 60)]
    rounds = [Round(ALWAYS, rms_distance(50, 8)), Round(ALWAYS, rms_distance(10, 8), 2)]
    database = build(training(*pictures), 8, rounds, progress=told.append)
    assert levels(database) == [0, 60, 40]
    assert [(p.round_number, p.image_number, p.added, p.tiles) for p in told] == [
        (0, 0, 1, 1),
        (0, 1, 0, 1),
        (0, 2, 0, 1),
        (0, 3, 1, 2),
        (1, 0, 0, 2),
        (1, 2, 1, 3),
    ]
    assert math.isnan(told[0].fom)
    assert told[1].name == "picture 1"
    assert told[4].images_in_round == 2


def test_it_stops_at_the_most_tiles_in_the_middle_of_an_image() -> None:
    told: list[BuildProgress] = []
    database = build(
        training(flat(0, 30), flat(60, 90, 120), flat(200)), 8, [Round(ALWAYS, 0.0)], max_tiles=4, progress=told.append
    )
    assert levels(database) == [0, 30, 60, 90]
    assert len(told) == 2


def test_a_core_is_added_to_and_its_indices_stay() -> None:
    core = TileDatabase.from_tiles(8, cut_tiles(flat(5, 150), 8))
    database = build(training(flat(6), flat(151, 250)), 8, [Round(ALWAYS, rms_distance(16, 8))], core=core)
    assert levels(database) == [5, 150, 250]


@pytest.mark.parametrize(("available", "wanted", "numbers"), [(5, None, [0, 1, 2, 3, 4]), (5, 9, [0, 1, 2, 3, 4])])
def test_all_images_are_looked_at_unless_fewer_are_wanted(
    available: int, wanted: int | None, numbers: list[int]
) -> None:
    assert list(spread(available, wanted)) == numbers


def test_fewer_images_are_spread_evenly_from_the_first() -> None:
    assert spread(10, 5) == (0, 2, 4, 6, 8)
    assert spread(7, 3) == (0, 2, 4)


def test_the_same_images_give_the_same_identity() -> None:
    pictures = training(*[image(seed) for seed in range(5)])
    rounds = [Round(ALWAYS, rms_distance(20, 8))]
    assert build(pictures, 8, rounds).identity == build(pictures, 8, rounds).identity
    assert build(pictures[::-1], 8, rounds).identity != build(pictures, 8, rounds).identity


class Killed(BaseException):
    """Stands for the process being killed."""


@pytest.mark.parametrize("killed_after", [1, 2, 4, 6, 9])
def test_a_killed_build_goes_on_to_the_same_codebook(tmp_path: Path, killed_after: int) -> None:
    pictures = [image(seed) for seed in range(6)]
    rounds = [Round(ALWAYS, rms_distance(45, 8)), Round(ALWAYS, rms_distance(40, 8), 4)]
    whole = build(training(*pictures), 8, rounds)
    journal = tmp_path / "part.journal"
    told: list[BuildProgress] = []

    def kill(progress: BuildProgress) -> None:
        told.append(progress)
        if len(told) == killed_after:
            raise Killed

    with pytest.raises(Killed):
        build(training(*pictures), 8, rounds, journal_path=journal, progress=kill)
    data = journal.read_bytes()
    for torn in (0, 3):  # the last record whole, and cut off while it was written
        journal.write_bytes(data[: len(data) - torn])
        worked_on: list[BuildProgress] = []
        resumed = build(training(*pictures), 8, rounds, journal_path=journal, progress=worked_on.append)
        assert resumed.identity == whole.identity
        assert len(worked_on) == 10 - killed_after + (1 if torn else 0)
    again: list[BuildProgress] = []
    assert build(training(*pictures), 8, rounds, journal_path=journal, progress=again.append).identity == whole.identity
    assert again == []


def test_a_journal_cut_anywhere_or_with_a_bad_byte_keeps_only_whole_records(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    entries = [JournalEntry(EntryKind.IMAGE, 0, i, bytes(32), np.full((i, 16), i, np.uint8)) for i in range(4)]
    with Journal(path, "plan", 16) as journal:
        for entry in entries:
            journal.append(entry)
    data = path.read_bytes()
    ends = np.cumsum([len(MAGIC) + 32, *(47 + 16 * i for i in range(4))])
    assert ends[-1] == len(data)
    for length in range(len(data) + 1):
        path.write_bytes(data[:length])
        with Journal(path, "plan", 16) as journal:
            whole = [e.image_number for e in journal.entries()]
        assert len(whole) == max(0, int((ends <= length).sum()) - 1)
    for position in range(int(ends[0]), len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 0x40
        path.write_bytes(damaged)
        with Journal(path, "plan", 16) as journal:
            assert len(list(journal.entries())) == int((ends[1:] <= position).sum())


def test_a_journal_of_another_build_or_no_journal_is_refused(tmp_path: Path) -> None:
    journal = tmp_path / "part.journal"
    pictures = training(image(0), image(1))
    build(pictures, 8, [Round(ALWAYS, 100.0)], journal_path=journal)
    before = journal.read_bytes()
    with pytest.raises(CodebookError, match="plan"):
        build(pictures, 8, [Round(ALWAYS, 101.0)], journal_path=journal)
    with pytest.raises(CodebookError, match="plan"):
        build(pictures[::-1], 8, [Round(ALWAYS, 100.0)], journal_path=journal)
    assert journal.read_bytes() == before
    journal.write_bytes(b"some other file of the user's")
    with pytest.raises(CodebookError, match="magic"):
        build(pictures, 8, [Round(ALWAYS, 100.0)], journal_path=journal)
    assert journal.read_bytes() == b"some other file of the user's"
    with pytest.raises(CodebookError, match="read and written"):
        build(pictures, 8, [Round(ALWAYS, 100.0)], journal_path=tmp_path / "absent" / "journal")


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
def test_a_plan_that_makes_no_sense_is_refused(field: str, changes: dict[str, object]) -> None:
    plan = {"images": training(image(0)), "tile_px": 8, "rounds": [Round(1, 1.0)]} | changes
    with pytest.raises(ConfigError) as caught:
        build(**plan)
    assert caught.value.field == field


@pytest.mark.parametrize("tile_px", [4, 20, 32])
def test_the_growing_search_is_exact_as_it_grows(tile_px: int) -> None:
    rng = np.random.default_rng(0)
    tiles = np.where(rng.random((5000, tile_px**2)) < 0.5, rng.integers(0, 256, (5000, tile_px**2)), 255).astype(
        np.uint8
    )
    growing = IncrementalTileSet(tile_px, 5000)
    for start in range(0, 5000, 700):
        growing.append(tiles[start : start + 700])
    assert np.array_equal(growing.tiles(), tiles)
    queries = tiles[::499].copy()
    queries[:, 0] ^= 0xFF
    index, squared = growing.nearest(queries)
    for query, found, value in zip(queries, index, squared, strict=True):
        distances = ((tiles.astype(np.int64) - query.astype(np.int64)) ** 2).sum(axis=1)
        assert value == distances.min()
        assert found == np.argmin(distances)


def test_refining_lowers_the_error_on_the_training_images_and_keeps_the_size() -> None:
    pictures = training(*[image(seed, 80) for seed in range(6)])
    database = build(pictures, 8, [Round(ALWAYS, rms_distance(10, 8))], max_tiles=60)
    errors: list[float] = []
    refined = refine(database, pictures, 4, lambda _, rms: errors.append(rms))
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > errors[-1]
    assert len(refined) <= len(database)
    assert refine(database, pictures, 0) is database


def test_refining_takes_the_rounded_mean_and_leaves_unused_tiles() -> None:
    database = TileDatabase.from_tiles(8, cut_tiles(flat(10, 100, 250), 8))
    refined = refine(database, training(flat(8, 9, 12, 101, 102)), 1)
    assert levels(refined) == [10, 102, 250]  # (8 + 9 + 12) / 3 = 9.67; (101 + 102) / 2 = 101.5 rounds up
