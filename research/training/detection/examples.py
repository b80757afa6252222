"""Make the training examples of the classifier: chips with labels from simulated surveys and real recordings.

    python -m research.training.detection.examples --data "$SONARPOST_DATA" --out /tmp/detection/examples.npz

    python -m research.training.detection.examples --data DIR --hard network.npz --out hard.npz

Five sources:

* Simulated surveys of every seabed, with random sonars, objects and disturbances. The candidates of the matched filter
  are labelled by the ground truth.
* The tiles of SDVD's train split: candidates in the box of a target are mine-like, the others are seabed. The test
  split is not read.
* Real surveys (`RECORDINGS`): candidates of weak response are seabed. Strong ones are left out: nothing states what
  they are.
* Simulated objects in real seabed: the difference in level between a simulated survey with and without an object, both
  without speckle, is added to windows of the real recordings and of SDVD's train split.
* With `--hard`, only these: of each simulated survey on rock, mixed seabed and ripples, the 120 seabed candidates that
  the given network takes for objects with the greatest probability.

Seeds 20,000 to 20,999 are used here; the evaluation (`python -m research.detection`) uses seeds from 5000 on.
"""

from __future__ import annotations

import argparse
import io
import multiprocessing
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image

from research.common.images import SdvdTile, read_sdvd_index, survey_line
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.detection.candidates import candidate_peaks
from sonarpost.detection.chips import (
    COARSE_CENTRE,
    COARSE_SHAPE,
    COARSE_STEP,
    FINE_CENTRE,
    FINE_SHAPE,
    WINDOW_CENTRE,
    WINDOW_SHAPE,
    ChipBatch,
    ChipCutter,
    GroundPlane,
    coarse_planes,
    geometry_values,
    ground_plane,
)
from sonarpost.detection.classifier import MINE_LIKE_OBJECT, OTHER_OBJECT, SEABED, Classifier, load_classifier
from sonarpost.detection.images import ScaledImage, normalise_window, seabed_window
from sonarpost.detection.matched_filter import Peak, matched_response
from sonarpost.detection.normalisation import LevelGrid, normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.objects import (
    CLUTTER_KINDS,
    FURTHER_CLUTTER_KINDS,
    FURTHER_MINE_LIKE_KINDS,
    MINE_LIKE_KINDS,
    STRUCTURE_KINDS,
)
from sonarpost.extensions.simulation.seabed.spec import SurveySpec
from sonarpost.extensions.simulation.seabed.survey import TruthObject, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.image_files import read_image
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import FloatImage, Side, Survey

SETTINGS: Final = DetectorSettings()
FIRST_SEED: Final = 20_000
SURVEYS: Final = 450
PASTED_SURVEYS: Final = 36
RECORDINGS: Final = ("surveys/scotsman-iver2.xtf", "surveys/000_1236.xtf", "surveys/humminbird")
IGNORED: Final = -1
_SEABED_PER_SIDE: Final = 150
_HARD_SEABEDS: Final = (SeabedKind.ROCK, SeabedKind.MIXED, SeabedKind.RIPPLES)
_HARD_PER_SURVEY: Final = 120
_NEAR_M: Final = 1.2
"""A candidate within this distance of the centre of an object shows it."""
_AMBIGUOUS_M: Final = 3.0
"""Candidates between `_NEAR_M` and this distance are left out."""
_WEAK_RESPONSE: Final = 3.0
"""Candidates of real surveys below this matched-filter response are seabed."""
_PASTED: Final = {1: 12, 2: 2500}
"""Objects pasted into each tile, and into each side of a recording."""
_NOISE_LEVEL: Final = -3.0
_LEVEL_SCALE: Final = 30.0
_TARGET_PX: Final = 22
"""Half the side of the box of a target of SDVD."""

Labels = npt.NDArray[np.int8]
Bytes = npt.NDArray[np.int8]


@dataclass(frozen=True)
class Examples:
    """Chips with labels, stored as 8 bits.

    Attributes:
        fine: Shape (examples, 40, 60, 2), int8: planes of `ChipBatch` times 30.
        coarse: Shape (examples, 30, 44, 3), int8, likewise.
        geometry: Shape (examples, 5), float32.
        label: Shape (examples,), int8: class of the classifier.
        source: Shape (examples,), int8: 0 simulated, 1 SDVD, 2 recordings, 3 simulated objects in real seabed, 4 hard
            simulated seabed.
        group: Shape (examples,), int32: survey, recording or survey line.
    """

    fine: Bytes
    coarse: Bytes
    geometry: npt.NDArray[np.float32]
    label: Labels
    source: npt.NDArray[np.int8]
    group: npt.NDArray[np.int32]

    @classmethod
    def of_chips(cls, chips: ChipBatch, label: Labels, source: int, group: int) -> Examples:
        """Return the chips of one source and group as examples."""
        return cls(
            _bytes(chips.fine),
            _bytes(chips.coarse),
            chips.geometry,
            label.astype(np.int8),
            np.full(len(chips), source, np.int8),
            np.full(len(chips), group, np.int32),
        )

    def of_source(self, source: int) -> Examples:
        """Return the same examples with another source."""
        return replace(self, source=np.full_like(self.source, source))

    @classmethod
    def joined(cls, parts: Sequence[Examples]) -> Examples:
        """Return the examples of all parts."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def save(self, path: Path) -> None:
        """Write an npz file."""
        np.savez(path, **{name: getattr(self, name) for name in self.__dataclass_fields__})

    @classmethod
    def load(cls, path: Path) -> Examples:
        """Read an npz file that `save` wrote."""
        with np.load(path, allow_pickle=False) as table:
            return cls(*(table[name] for name in cls.__dataclass_fields__))


def _bytes(planes: npt.NDArray[np.float32]) -> Bytes:
    return np.asarray(np.clip(np.rint(planes * _LEVEL_SCALE), -127, 127), dtype=np.int8)


def random_spec(seed: int) -> SurveySpec:
    """Return the specification of a training survey: sonar, track, objects and disturbances drawn from the seed."""
    rng = np.random.default_rng(seed)
    kinds = list(SeabedKind)
    # Rock and mixed seabeds, on which detection is hard, are drawn more often.
    seabed = kinds[int(rng.choice(len(kinds), p=[0.12, 0.14, 0.12, 0.08, 0.27, 0.27]))]
    range_m = float(rng.choice([20.0, 30.0, 30.0, 30.0, 40.0, 50.0, 75.0]))
    altitude_m = float(min(rng.uniform(0.08, 0.24) * range_m, 10.0))
    speed_mps = float(rng.uniform(1.0, 2.2))
    limits = min(15.0, 700 / range_m)
    pings = 700
    mines = [*MINE_LIKE_KINDS, *FURTHER_MINE_LIKE_KINDS]
    others = [*CLUTTER_KINDS, *FURTHER_CLUTTER_KINDS]
    targets = [mines[int(k)] for k in rng.integers(len(mines), size=6)]
    clutter = [others[int(k)] for k in rng.integers(len(others), size=7)]
    if rng.random() < 0.3:
        clutter[0] = list(STRUCTURE_KINDS)[int(rng.integers(len(STRUCTURE_KINDS)))]
    plain = rng.random() < 0.35
    spec = SurveySpec(
        seed=seed,
        pings=pings,
        samples=int(rng.choice([512, 1024, 1024, 1024, 2048])),
        range_m=range_m,
        altitude_m=max(altitude_m, 1.2),
        speed_mps=speed_mps,
        ping_rate_hz=float(rng.uniform(0.55, 1.0) * limits),
        seabed=seabed,
        targets=tuple(targets),
        clutter=tuple(clutter),
        bits=int(rng.choice([8, 16])),
        motion=float(rng.uniform(0.5, 2.0)),
        frequency_hz=float(rng.choice([450e3, 600e3, 900e3])),
    )
    return spec if plain else with_disturbances(spec, rng)


def with_disturbances(spec: SurveySpec, rng: np.random.Generator) -> SurveySpec:
    """Return the specification with burial, scour, and a receiver that differs from the default one."""

    def sometimes(value: float, share: float = 0.5, otherwise: float = 0.0) -> float:
        return float(value) if rng.random() < share else otherwise

    return replace(
        spec,
        burial=sometimes(rng.uniform(0, 0.6)),
        tilt_deg=sometimes(rng.uniform(0, 20)),
        scour=sometimes(rng.uniform(0.3, 2.0)),
        ripple_wavelength_m=sometimes(rng.uniform(0.3, 4.0), otherwise=0.8),
        ripple_systems=int(rng.integers(1, 4)),
        tvg_error=sometimes(rng.uniform(-1, 1)),
        gain_steps=int(sometimes(int(rng.integers(1, 6)), 0.3)),
        gain_step_db=float(rng.uniform(2, 8)),
        crosstalk_db=-float(rng.uniform(20, 45)) if rng.random() < 0.3 else None,
        beam_width_deg=float(rng.uniform(0.3, 1.2)),
        pulse_sigma_samples=float(rng.uniform(0.5, 2.0)),
        surface_return=sometimes(rng.uniform(0.2, 2), 0.2),
    )


def label_of(truth: Sequence[TruthObject], side: Side, row: float, sample: float, row_m: float, sample_m: float) -> int:
    """Return the class of a place; `IGNORED` near an object but not at it, and in its shadow."""
    label = SEABED
    for item in truth:
        if item.side is not side:
            continue
        along_m, across_m = (row - item.ping) * row_m, (sample - item.sample_index) * sample_m
        turn = np.radians(item.orientation_deg)
        # Distances from the border of the object's rectangle, along and across its long axis.
        u_m = abs(along_m * np.cos(turn) + across_m * np.sin(turn)) - item.length_m / 2
        v_m = abs(across_m * np.cos(turn) - along_m * np.sin(turn)) - item.width_m / 2
        border_m = max(u_m, v_m)
        if item.is_mine_like:
            distance_m = max(abs(along_m), abs(across_m))
            if distance_m < _NEAR_M:
                return MINE_LIKE_OBJECT
            near = distance_m < _AMBIGUOUS_M
        else:
            if border_m < 0.6:
                label = OTHER_OBJECT
                continue
            near = border_m < 2.0 or (0 < across_m < 12 and abs(along_m) < item.length_m / 2)
        if near and label == SEABED:
            label = IGNORED
    return label


def simulated_examples(seed: int, seabed_per_side: int = _SEABED_PER_SIDE) -> Examples | None:
    """Return the examples of one simulated survey; None if its objects do not fit on the line.

    Args:
        seed: Seed of the survey.
        seabed_per_side: Maximum number of seabed candidates of each side, chosen at random.
    """
    simulated = _simulated(random_spec(seed))
    if simulated is None:
        return None
    survey, truth = simulated
    rng = np.random.default_rng(seed)
    parts = []
    for side in survey.sides():
        grid = normalise_side(survey, side, SETTINGS, altitudes_m(survey))
        if grid is None:
            continue
        found = candidate_peaks(matched_response(grid, SETTINGS), grid, SETTINGS)
        sample_m = grid.cell_across_m / grid.samples_per_cell
        labels = np.array(
            [
                label_of(truth, side, p.row, (p.cell + 0.5) * grid.samples_per_cell, grid.row_along_m, sample_m)
                for p in found
            ],
            dtype=np.int64,
        )
        seabed = np.flatnonzero(labels == SEABED)
        chosen = rng.permutation(seabed)[:seabed_per_side]
        kept = np.sort(np.concatenate([np.flatnonzero(labels > SEABED), chosen])).astype(np.int64)
        chips = ChipCutter(grid).chips([found[i] for i in kept])
        parts.append(Examples.of_chips(chips, labels[kept].astype(np.int8), 0, seed))
    return Examples.joined(parts) if parts else None


def hard_examples(work: tuple[int, Classifier]) -> Examples | None:
    """Return the seabed candidates of one survey that a network takes for objects; None on an easy seabed."""
    seed, classifier = work
    if random_spec(seed).seabed not in _HARD_SEABEDS:
        return None
    found = simulated_examples(seed, seabed_per_side=10_000)
    if found is None:
        return None
    rows = np.flatnonzero(found.label == SEABED)
    scale = np.float32(1 / _LEVEL_SCALE)
    chips = ChipBatch(found.fine[rows] * scale, found.coarse[rows] * scale, found.geometry[rows])
    hardest = rows[np.argsort(classifier.probabilities(chips)[:, SEABED], kind="stable")[:_HARD_PER_SURVEY]]
    return Examples(*(getattr(found, name)[hardest] for name in Examples.__dataclass_fields__)).of_source(4)


def _simulated(spec: SurveySpec) -> tuple[Survey, tuple[TruthObject, ...]] | None:
    try:
        simulated = simulate_survey(spec)
    except ConfigError:
        return None
    return simulated.survey, simulated.truth


@dataclass(frozen=True)
class ObjectWindow:
    """The change of level that an object causes, in a window of fine pixels around it.

    Attributes:
        change: Shape (120, 176), float32, in levels.
        label: Its class.
    """

    change: FloatImage
    label: int


def object_windows(seed: int) -> list[ObjectWindow]:
    """Return the change that each object of one survey causes: its levels with and without objects, no speckle."""
    base = random_spec(seed)
    spec = replace(base, pings=700, seabed=SeabedKind.SAND, motion=0.5, bits=16)
    try:
        with_objects = simulate_survey(spec, speckle=False)
    except ConfigError:
        return []
    without = simulate_survey(replace(spec, targets=0, clutter=0), speckle=False)
    windows = []
    for side in with_objects.survey.sides():
        altitude_m = altitudes_m(without.survey)
        changed, plain = (normalise_side(s.survey, side, SETTINGS, altitude_m) for s in (with_objects, without))
        if changed is None or plain is None:
            continue
        planes = ground_plane(replace(changed, first_return_cell=plain.first_return_cell)), ground_plane(plain)
        change = planes[0].level - planes[1].level
        change[(planes[0].known < 0.5) | (planes[1].known < 0.5)] = 0.0
        change[np.abs(change) < 0.15] = 0.0
        for item in with_objects.truth:
            if item.side is not side or item.kind in STRUCTURE_KINDS:
                continue
            others = [t for t in with_objects.truth if t is not item and t.side is side]
            if any(abs(t.ping - item.ping) * plain.row_along_m < 8.0 for t in others):
                continue
            row, column = planes[0].pixel_of(item.ping, item.sample_index // plain.samples_per_cell)
            window = _window(change, row, column)
            if np.abs(window).max() > 0.5:
                windows.append(ObjectWindow(window, MINE_LIKE_OBJECT if item.is_mine_like else OTHER_OBJECT))
    return windows


def _window(plane: FloatImage, row: int, column: int) -> FloatImage:
    """Return the window of a chip around a pixel; 0 beyond the plane."""
    margin = max(WINDOW_SHAPE)
    padded = np.pad(plane, margin)
    top, left = row + margin - WINDOW_CENTRE[0], column + margin - WINDOW_CENTRE[1]
    return padded[top : top + WINDOW_SHAPE[0], left : left + WINDOW_SHAPE[1]]


@dataclass(frozen=True)
class Scene:
    """A side of a real recording or a tile, for backgrounds and seabed candidates.

    Attributes:
        grid: Its levels.
        candidates: Its matched-filter peaks.
        target: Rows and columns of the target in the grid (top, left, bottom, right), if it has one.
        source: 1 SDVD, 2 recording.
        group: Survey line.
    """

    grid: LevelGrid
    candidates: tuple[Peak, ...]
    target: tuple[float, float, float, float] | None
    source: int
    group: int


def recording_scenes(path: Path, group: int) -> list[Scene]:
    """Return both sides of a real survey."""
    survey = read_survey(path if path.is_file() else next(path.glob("*.DAT")))
    altitude_m = altitudes_m(survey)
    grids = [normalise_side(survey, side, SETTINGS, altitude_m) for side in survey.sides()]
    return [_scene(grid, None, 2, group) for grid in grids if grid is not None]


def tile_scenes(data: Path, tile: SdvdTile, group: int) -> list[Scene]:
    """Return a tile of SDVD at several pixel sizes, each coded once more as JPEG.

    A target casts its shadow to one side only: of the two directions, the one with the stronger response at the target
    is used.
    """
    pixels = read_image(data / "snippets" / "sdvd" / tile.split / "images" / tile.image)
    rng = np.random.default_rng(group)
    found = []
    for pixel_m in (0.04, 0.05, 0.06):
        scenes = []
        for side in Side:
            window = seabed_window(ScaledImage(_recoded(pixels, int(rng.integers(60, 96))), pixel_m, pixel_m))
            grid = None if window is None else normalise_window(window, side)
            if window is None or grid is None:
                continue
            box = None
            if tile.target_centre is not None:
                x, y = tile.target_centre[0] - window.left, tile.target_centre[1] - window.top
                box = _box_in_grid((x, y), grid, side, pixel_m, window.values.shape[1])
            scenes.append(_scene(grid, box, 1, group))
        if tile.target_centre is not None and len(scenes) == 2:
            scenes = [max(scenes, key=_response_at_target)]
        found += scenes
    return found


def _recoded(pixels: npt.NDArray[np.uint8] | npt.NDArray[np.uint16], quality: int) -> npt.NDArray[np.uint8]:
    buffer = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8)).save(buffer, "JPEG", quality=quality)
    return np.asarray(Image.open(buffer))


def _box_in_grid(
    centre: tuple[int, int], grid: LevelGrid, side: Side, pixel_m: float, width: int
) -> tuple[float, float, float, float]:
    x, y = centre if side is Side.STARBOARD else (width - centre[0], centre[1])
    row, cell = y * pixel_m / grid.row_along_m, x * pixel_m / grid.cell_across_m
    half_rows, half_cells = _TARGET_PX * pixel_m / grid.row_along_m, _TARGET_PX * pixel_m / grid.cell_across_m
    return row - half_rows, cell - half_cells, row + half_rows, cell + half_cells


def _in_box(peak: Peak, box: tuple[float, float, float, float], margin: float = 0.0) -> bool:
    top, left, bottom, right = box
    return top - margin <= peak.row <= bottom + margin and left - margin <= peak.cell <= right + margin


def _response_at_target(scene: Scene) -> float:
    assert scene.target is not None
    return max((p.score for p in scene.candidates if _in_box(p, scene.target)), default=0.0)


def _scene(grid: LevelGrid, target: tuple[float, float, float, float] | None, source: int, group: int) -> Scene:
    return Scene(grid, candidate_peaks(matched_response(grid, SETTINGS), grid, SETTINGS), target, source, group)


def scene_examples(scene: Scene) -> Examples:
    """Return the candidates of a scene that have a known label."""
    labels = []
    for peak in scene.candidates:
        if scene.target is not None and _in_box(peak, scene.target):
            labels.append(MINE_LIKE_OBJECT)
        else:
            near = scene.target is not None and _in_box(peak, scene.target, 2.5 / scene.grid.cell_across_m)
            strong = scene.source == 2 and peak.score >= _WEAK_RESPONSE
            labels.append(IGNORED if near or strong else SEABED)
    kept = [i for i, label in enumerate(labels) if label != IGNORED]
    chips = ChipCutter(scene.grid).chips([scene.candidates[i] for i in kept])
    return Examples.of_chips(chips, np.array([labels[i] for i in kept], dtype=np.int8), scene.source, scene.group)


def pasted_examples(scene: Scene, windows: Sequence[ObjectWindow], count: int, seed: int) -> Examples | None:
    """Return objects pasted into places of a scene that are mostly known; None if there is no such place."""
    rng = np.random.default_rng(seed)
    plane = ground_plane(scene.grid)
    batches: list[ChipBatch] = []
    labels: list[int] = []
    for _ in range(4 * count):
        row, cell = (int(rng.integers(n)) for n in scene.grid.level.shape)
        peak = Peak(row, cell, 1.0, 1, 1)
        if scene.target is not None and _in_box(peak, scene.target, 4.0 / scene.grid.cell_across_m):
            continue
        if len(labels) == count:
            break
        at = plane.pixel_of(row, cell)
        level, known = _window(plane.level, *at), _window(plane.known, *at)
        near = known[WINDOW_CENTRE[0] - 8 : WINDOW_CENTRE[0] + 8, WINDOW_CENTRE[1] - 8 : WINDOW_CENTRE[1] + 24]
        if near.mean() < 0.9:
            continue
        chosen = windows[int(rng.integers(len(windows)))]
        batches.append(pasted_chip(level, known, chosen, plane, peak, rng))
        labels.append(chosen.label)
    if not labels:
        return None
    planes = ([getattr(batch, name) for batch in batches] for name in ("fine", "coarse", "geometry"))
    chips = ChipBatch(*map(np.concatenate, planes))
    return Examples.of_chips(chips, np.array(labels, dtype=np.int8), 3, scene.group)


def pasted_chip(
    level: FloatImage,
    known: FloatImage,
    window: ObjectWindow,
    plane: GroundPlane,
    peak: Peak,
    rng: np.random.Generator,
) -> ChipBatch:
    """Return the chip of an object in a real window, up to 0.4 m from the centre and with a random strength."""
    change = np.roll(window.change, rng.integers(-3, 4, size=2), axis=(0, 1))
    if rng.random() < 0.5:
        change = change[::-1]
    change = change * rng.uniform(0.6, 1.2)
    # In the shadow remains the noise of the receiver, which has speckle too.
    noise = _NOISE_LEVEL + rng.uniform(-0.5, 1.0) + 0.5 * rng.standard_normal(level.shape)
    pasted = np.where(change < 0, np.maximum(level + change, np.minimum(level, noise)), level + change)
    pasted = np.clip(np.where(known > 0, pasted, 0.0), -4, 4).astype(np.float32)
    coarse = coarse_planes(pasted, known)
    rows = WINDOW_CENTRE[0] + (np.arange(COARSE_SHAPE[0]) - COARSE_CENTRE[0]) * COARSE_STEP
    columns = WINDOW_CENTRE[1] + (np.arange(COARSE_SHAPE[1]) - COARSE_CENTRE[1]) * COARSE_STEP
    top, left = WINDOW_CENTRE[0] - FINE_CENTRE[0], WINDOW_CENTRE[1] - FINE_CENTRE[1]
    area = (slice(top, top + FINE_SHAPE[0]), slice(left, left + FINE_SHAPE[1]))
    fine = np.stack([pasted[area] * np.float32(0.5), known[area]], axis=-1)[None]
    return ChipBatch(fine, coarse[np.ix_(rows, columns)][None], geometry_values(plane, [peak]))


def _of_scenes(scenes: Sequence[Scene], windows: Sequence[ObjectWindow], seed: int) -> list[Examples]:
    parts = [scene_examples(scene) for scene in scenes]
    for number, scene in enumerate(scenes):
        pasted = pasted_examples(scene, windows, _PASTED[scene.source], seed + number)
        parts += [pasted] if pasted is not None else []
    return parts


_Work = tuple[Path, SdvdTile | None, int, Sequence[ObjectWindow]]


def real_examples(work: _Work) -> list[Examples]:
    """Return the examples of a tile, or of a recording: its own candidates and pasted objects."""
    path, tile, group, windows = work
    scenes = recording_scenes(path, group) if tile is None else tile_scenes(path, tile, group)
    return _of_scenes(scenes, windows, FIRST_SEED + 10 * group)


def make_examples(data: Path, surveys: int, pasted_surveys: int, workers: int) -> Examples:
    """Return all examples."""
    parts: list[Examples] = []
    with ProgressDisplay() as progress, multiprocessing.Pool(workers) as pool:
        windows: list[ObjectWindow] = []
        seeds = range(FIRST_SEED + 500, FIRST_SEED + 500 + pasted_surveys)
        for number, found in enumerate(pool.imap(object_windows, seeds), start=1):
            windows += found
            progress.show("simulated objects", number, pasted_surveys)
        tiles = [tile for tile in read_sdvd_index(data / "snippets" / "sdvd") if tile.split == "train"]
        lines = sorted({survey_line(tile.image) for tile in tiles})
        work: list[_Work] = [(data / name, None, 100 + number, windows) for number, name in enumerate(RECORDINGS)]
        work += [(data, tile, lines.index(survey_line(tile.image)), windows) for tile in tiles]
        for number, of_scenes in enumerate(pool.imap(real_examples, work), start=1):
            parts += of_scenes
            progress.show("real recordings", number, len(work))
        seeds = range(FIRST_SEED, FIRST_SEED + surveys)
        for number, part in enumerate(pool.imap(simulated_examples, seeds), start=1):
            parts += [part] if part is not None else []
            progress.show("simulated surveys", number, surveys)
    return Examples.joined(parts)


def make_hard_examples(classifier: Classifier, surveys: int, workers: int) -> Examples:
    """Return the hard examples of all surveys."""
    parts = []
    with ProgressDisplay() as progress, multiprocessing.Pool(workers) as pool:
        work = [(FIRST_SEED + number, classifier) for number in range(surveys)]
        for number, part in enumerate(pool.imap(hard_examples, work), start=1):
            parts += [part] if part is not None else []
            progress.show("simulated surveys", number, surveys)
    return Examples.joined(parts)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder of the real recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--hard", type=Path, metavar="NETWORK.npz", help="hard examples of this network only")
    parser.add_argument("--surveys", type=int, default=SURVEYS)
    parser.add_argument("--pasted-surveys", type=int, default=PASTED_SURVEYS)
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    if arguments.hard is not None:
        examples = make_hard_examples(load_classifier(arguments.hard), arguments.surveys, arguments.workers)
    else:
        examples = make_examples(arguments.data, arguments.surveys, arguments.pasted_surveys, arguments.workers)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    examples.save(arguments.out)
    for source in range(5):
        of_source = examples.label[examples.source == source]
        print(f"source {source}: " + ", ".join(f"{(of_source == label).sum()} of class {label}" for label in range(3)))


if __name__ == "__main__":
    main()
