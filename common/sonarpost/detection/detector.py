"""Detection of contacts in a survey: compact objects from the filters, and large structures.

Large structures (wrecks, walls) are a deep shadow of several square metres with a highlight before it. The filters for
compact objects compare a place with the seabed around it, but a wreck fills that neighbourhood. Its shadow is
detectable: metres wide and without echo. Shadows of ripples, stones and rock are lit from other sides. Each connected
dark region of at least 7 m² whose near edge is bright for a good part of its length is a structure.

Outcrops of rock cast such shadows too, but in large numbers: each distant region of comparable size reduces the
confidence. The simulator has no wrecks, so this confidence is not calibrated: 1.0 is the minimum area with a bright
edge along half of its length, and it increases with both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sonarpost.detection.candidates import Candidate, FilterScores, Measurement, find_candidates
from sonarpost.detection.fusion import fused_confidences, suppress_duplicates
from sonarpost.detection.normalisation import FloatVector, LevelGrid, normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import Position, georeference, sample_slant_range_m, slant_to_ground_range_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import SurveySource, load_survey
from sonarpost.sonar.survey import Side, Survey

_SMOOTH_M: Final = 0.4
_DARK_LEVEL: Final = -1.3
_BRIGHT_LEVEL: Final = 0.6
_MIN_AREA_M2: Final = 7.0
_EDGE_M: Final = 1.2
"""The highlight of a structure lies within this distance before its shadow."""
_EDGE_SHARE: Final = 0.5
_MIN_EDGE_SHARE: Final = 0.25
_MAX_LENGTH_M: Final = 60.0
_NEAR_M: Final = 2.0
_SEPARATE_M: Final = 20.0


@dataclass(frozen=True, slots=True)
class Structure:
    """A structure as a candidate, with its confidence and the area of its shadow in slant range."""

    confidence: float
    candidate: Candidate
    area_m2: float


def find_structures(grid: LevelGrid) -> list[Structure]:
    """Return the structures of one side, most confident first."""
    size = (max(1, round(_SMOOTH_M / grid.row_along_m)), max(1, round(_SMOOTH_M / grid.cell_across_m)))
    known = np.isfinite(grid.level)
    level = ndimage.uniform_filter(np.where(known, grid.level, 0.0).astype(np.float32), size=size, mode="nearest")
    labels, _ = ndimage.label(known & (level < _DARK_LEVEL))
    areas_m2 = np.bincount(labels.ravel()) * (grid.row_along_m * grid.cell_across_m)
    found = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None or areas_m2[number] < _MIN_AREA_M2:
            continue
        if (box[0].stop - box[0].start) * grid.row_along_m > _MAX_LENGTH_M:
            continue
        structure = _structure(grid, level, labels[box] == number, (box[0].start, box[1].start), areas_m2[number])
        if structure is not None:
            found.append(structure)
    weighted = [replace(s, confidence=s.confidence / (1 + _comparable(s, found, grid))) for s in found]
    return sorted(weighted, key=lambda s: -s.confidence)


def is_part_of_structure(contact: Candidate, structure: Candidate, grid: LevelGrid) -> bool:
    """Return whether the centre of a contact lies in or within 2 m of a structure's highlight or shadow."""
    rows, cells = _NEAR_M / grid.row_along_m, _NEAR_M / grid.cell_across_m
    centre, large = contact.measurement, structure.measurement
    along = large.rows[0] - rows <= centre.row < large.rows[1] + rows
    return along and large.cells[0] - cells <= centre.cell < large.cells[1] + large.shadow_cells + cells


def _comparable(one: Structure, found: list[Structure], grid: LevelGrid) -> int:
    """Return how many others of at least half the area are too far away to be parts of the same structure."""
    count = 0
    for other in found:
        along_m = abs(other.candidate.measurement.row - one.candidate.measurement.row) * grid.row_along_m
        across_m = abs(other.candidate.measurement.cell - one.candidate.measurement.cell) * grid.cell_across_m
        count += other.area_m2 >= one.area_m2 / 2 and max(along_m, across_m) > _SEPARATE_M
    return count


def _structure(
    grid: LevelGrid,
    level: npt.NDArray[np.float32],
    dark: npt.NDArray[np.bool_],
    corner: tuple[int, int],
    area: np.float64,
) -> Structure | None:
    """Return the structure that casts a shadow; None if less than a quarter of its near edge is bright.

    Args:
        grid: One side of a survey.
        level: Its smoothed levels.
        dark: The cells of the shadow within its bounding box.
        corner: First row and cell of that box.
        area: Area of the shadow in square metres.
    """
    area_m2 = float(area)
    reach = max(2, round(_EDGE_M / grid.cell_across_m))
    rows = np.flatnonzero(dark.any(axis=1))
    near = corner[1] + dark[rows].argmax(axis=1)
    columns = near[:, None] - 1 - np.arange(reach)[None, :]
    strip = np.where(columns >= 0, level[corner[0] + rows[:, None], np.maximum(columns, 0)], -np.inf)
    bright = strip > _BRIGHT_LEVEL
    lit = bright.any(axis=1)
    share = float(lit.mean())
    if share < _MIN_EDGE_SHARE:
        return None
    lit_rows = rows[lit]
    middle = int(np.flatnonzero(lit)[np.argmax(strip[lit].max(axis=1))])
    cells = bright[middle].nonzero()[0]
    last, first = int(near[middle]) - int(cells[0]), int(near[middle]) - 1 - int(cells[-1])
    shadow_end = corner[1] + int(np.flatnonzero(dark[rows[middle]])[-1]) + 1
    confidence = 2.0 * area_m2 / (area_m2 + _MIN_AREA_M2) * min(1.0, share / _EDGE_SHARE)
    patch = grid.level[corner[0] : corner[0] + dark.shape[0], corner[1] : corner[1] + dark.shape[1]]
    measurement = Measurement(
        row=corner[0] + int(rows[middle]),
        cell=(first + last) // 2,
        rows=(corner[0] + int(lit_rows[0]), corner[0] + int(lit_rows[-1]) + 1),
        cells=(max(first, 0), last),
        shadow_cells=shadow_end - last,
        shadow_is_cut=shadow_end >= grid.level.shape[1],
        matched=0.0,
        cfar=float(strip[lit].max(axis=1).mean()),
        shadow=float(-np.nanmean(patch[dark])),
        shadow_rows=int(rows[-1] - rows[0]) + 1,
    )
    scores = FilterScores(0.0, measurement.cfar, measurement.shadow, 0.0, min(1.0, share))
    return Structure(confidence, Candidate(measurement, scores), area_m2)


MINE_LIKE = "mine-like"
CLUTTER = "clutter"
STRUCTURE = "structure"
"""A wreck, wall or outcrop: an object larger than a mine, with its extent."""


@dataclass(frozen=True, slots=True)
class Detection:
    """One contact of the detector. A value that the survey does not contain is None.

    Attributes:
        side: Side of the vehicle.
        ping_index: Index into `Survey.pings` of the centre of the highlight.
        ping_number: Number of that ping in the file.
        sample: Sample index of the centre of the highlight in that ping's channel (0 is nearest the vehicle).
        time_utc_s: Time of that ping, seconds since 1970-01-01 UTC.
        vehicle: Position of the vehicle.
        position: Position of the object: abeam of the vehicle at the ground range.
        heading_deg: Heading of the vehicle, 0 to 360 (360 not included).
        altitude_m: Altitude of the vehicle: the file's, else from the first bottom return.
        depth_m: Depth of the vehicle.
        speed_mps: Speed of the vehicle.
        slant_range_m: Slant range of the centre of the highlight.
        ground_range_m: The same on a flat bottom.
        length_m: Along-track extent of the highlight; None if the distance between pings is unknown.
        width_m: Across-track extent of the highlight, in slant range.
        shadow_m: Length of the shadow in slant range, from the outer edge of the highlight.
        height_m: shadow x altitude / (slant range + shadow), by similar triangles over a flat bottom.
        shadow_is_cut: True if the recording ends within the shadow; `shadow_m` and `height_m` are then lower bounds.
        confidence: 0 to 2, see `sonarpost.detection.fusion`.
        scores: Scores of the filters.
        atd_class: `MINE_LIKE`, `CLUTTER` or `STRUCTURE`.
        p_mine_like: Probability that the contact is a mine-like object, 0 to 1; None if it was not classified.
        p_other_object: Probability that it is another object on the bottom, 0 to 1; None if it was not classified.
        pixel_along_m: Distance between two pings.
        pixel_across_m: Slant range of one sample.
        highlight_pings: First and one-past-last ping index of the highlight.
        highlight_samples: First and one-past-last sample of the highlight.
        shadow_samples: Length of the shadow in samples.
        position_sigma_m: One standard deviation of `position` along the worse axis of its error ellipse, from the error
            budget of the survey's options; None without a position.
    """

    side: Side
    ping_index: int
    ping_number: int
    sample: int
    time_utc_s: float
    vehicle: Position | None
    position: Position | None
    heading_deg: float | None
    altitude_m: float | None
    depth_m: float | None
    speed_mps: float | None
    slant_range_m: float
    ground_range_m: float | None
    length_m: float | None
    width_m: float
    shadow_m: float
    height_m: float | None
    shadow_is_cut: bool
    confidence: float
    scores: FilterScores
    atd_class: str
    pixel_along_m: float | None
    pixel_across_m: float
    highlight_pings: tuple[int, int]
    highlight_samples: tuple[int, int]
    shadow_samples: int
    position_sigma_m: float | None = None
    p_mine_like: float | None = None
    p_other_object: float | None = None


LISTED_CONFIDENCES: Final = (1.0, 0.5, 0.3, 0.1)
"""Confidences below the threshold at which a search counts contacts."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of one search.

    Attributes:
        detections: Contacts of both sides at or above the confidence threshold, most confident first.
        weaker: What lower thresholds would give: for each of `LISTED_CONFIDENCES` below the threshold, the ping index
            of each contact at or above that confidence.
    """

    detections: tuple[Detection, ...]
    weaker: Mapping[float, tuple[int, ...]]


def counts_text(threshold: float, count: int, weaker: Mapping[float, int]) -> str:
    """Return the number of contacts at the threshold and at lower ones as text.

    >>> counts_text(1.0, 0, {0.5: 2, 0.3: 7})
    '0 contacts above 1.0; 2 above 0.5, 7 above 0.3'
    """
    lower = ", ".join(f"{number} above {confidence}" for confidence, number in weaker.items())
    return f"{count} contacts above {threshold}" + (f"; {lower}" if lower else "")


def detect(
    survey: Survey | SurveySource, settings: DetectorSettings | None = None, options: SurveyOptions | None = None
) -> tuple[Detection, ...]:
    """Detect the contacts of a survey.

    Args:
        survey: The recording; both sides, any sample type. An open recording is loaded into memory (at most 1 GiB of
            samples).
        settings: None for the defaults.
        options: The options with which the survey was opened, for the error budget; None for the defaults.

    Returns:
        The contacts of both sides at or above the confidence threshold, most confident first. Empty for a survey
        without samples.

    Raises:
        SurveyFileError: An open recording is larger, or its file cannot be read.
    """
    if isinstance(survey, SurveySource):
        options = options if options is not None else survey.options
        survey = load_survey(survey)
    return search(survey, settings, options).detections


def search(
    survey: Survey, settings: DetectorSettings | None = None, options: SurveyOptions | None = None
) -> SearchResult:
    """Detect the contacts of a survey in memory, and count those that lower thresholds would give.

    Args:
        survey: The recording.
        settings: None for the defaults. `weaker` is not limited to the maximum number of contacts.
        options: As for `detect`.
    """
    settings = settings if settings is not None else DetectorSettings()
    options = options if options is not None else SurveyOptions()
    altitude_m = altitudes_m(survey)
    found: list[Detection] = []
    weaker: dict[float, list[int]] = {c: [] for c in LISTED_CONFIDENCES if c < settings.confidence_threshold}
    for side in survey.sides():
        grid = normalise_side(survey, side, settings, altitude_m)
        if grid is None:
            continue
        contacts = _SideContacts(grid, settings, min((settings.confidence_threshold, *weaker)))
        for confidence, rows in weaker.items():
            candidates = (candidate for _, candidate in contacts.at(confidence))
            rows += [c.measurement.row for c in candidates if survey.pings[c.measurement.row].channel(side) is not None]
        for confidence, candidate in contacts.at(settings.confidence_threshold):
            detection = _detection(survey, grid, confidence, candidate, settings, options, altitude_m)
            found += [detection] if detection is not None else []
    found.sort(key=lambda d: (-d.confidence, d.ping_index, d.side.value, d.sample))
    return SearchResult(tuple(found[: settings.max_contacts]), {c: tuple(rows) for c, rows in weaker.items()})


class _SideContacts:
    """The contacts of one side at any threshold down to `lowest`."""

    def __init__(self, grid: LevelGrid, settings: DetectorSettings, lowest: float) -> None:
        candidates = find_candidates(grid, settings)
        scored = zip(fused_confidences(candidates, grid, settings), candidates, strict=True)
        # Only more confident candidates suppress one: those at a higher threshold are the first of this list.
        self._kept = suppress_duplicates([c for c in scored if c[0] >= lowest], grid, settings)
        self._structures = find_structures(grid)
        self._grid = grid

    def at(self, threshold: float) -> list[tuple[float, Candidate]]:
        """Return confidence and candidate of each contact at or above a threshold."""
        kept = [c for c in self._kept if c[0] >= threshold]
        # A structure that contains a contact or a more confident structure is not reported again.
        for structure in self._structures:
            if structure.confidence < threshold:
                break
            if not any(is_part_of_structure(other, structure.candidate, self._grid) for _, other in kept):
                kept.append((structure.confidence, structure.candidate))
        return kept


def _detection(
    survey: Survey,
    grid: LevelGrid,
    confidence: float,
    candidate: Candidate,
    settings: DetectorSettings,
    options: SurveyOptions,
    altitudes: FloatVector,
) -> Detection | None:
    """Convert a candidate from grid cells to metres and positions; None if its ping has no such channel."""
    measurement = candidate.measurement
    ping = survey.pings[measurement.row]
    channel = ping.channel(grid.side)
    if channel is None:
        return None
    across_m = channel.sample_spacing_m
    samples = (measurement.cells[0] * grid.samples_per_cell, measurement.cells[1] * grid.samples_per_cell)
    sample = min((samples[0] + samples[1]) // 2, channel.samples.shape[0] - 1)
    slant_m = sample_slant_range_m(channel, sample)
    altitude_m = _altitude_m(altitudes, grid, measurement.row)
    ground_m = float(slant_to_ground_range_m(slant_m, altitude_m)) if altitude_m is not None else math.nan
    length_m = (measurement.rows[1] - measurement.rows[0]) * grid.row_along_m
    width_m = (samples[1] - samples[0]) * across_m
    shadow_m = measurement.shadow_cells * grid.samples_per_cell * across_m
    height_m = height_from_shadow_m(shadow_m, slant_m, altitude_m) if altitude_m is not None else None
    reference = georeference(ping, grid.side, sample, options, tracked_altitude_m=altitude_m)
    has_fix = ping.lat_deg is not None and ping.lon_deg is not None
    return Detection(
        side=grid.side,
        ping_index=measurement.row,
        ping_number=ping.number,
        sample=sample,
        time_utc_s=ping.time_utc_s,
        vehicle=Position(ping.lat_deg, ping.lon_deg) if has_fix else None,  # type: ignore[arg-type]
        position=None if reference is None else reference.position,
        heading_deg=None if ping.heading_deg is None else ping.heading_deg % 360.0,
        altitude_m=altitude_m,
        depth_m=ping.depth_m,
        speed_mps=ping.speed_mps,
        slant_range_m=slant_m,
        ground_range_m=None if math.isnan(ground_m) else ground_m,
        length_m=length_m if grid.row_is_measured else None,
        width_m=width_m,
        shadow_m=shadow_m,
        height_m=height_m,
        shadow_is_cut=measurement.shadow_is_cut,
        confidence=confidence,
        scores=candidate.scores,
        atd_class=classify(length_m, width_m, height_m, settings),
        pixel_along_m=grid.row_along_m if grid.row_is_measured else None,
        pixel_across_m=across_m,
        highlight_pings=measurement.rows,
        highlight_samples=samples,
        shadow_samples=measurement.shadow_cells * grid.samples_per_cell,
        position_sigma_m=None if reference is None else reference.sigma_m,
    )


def height_from_shadow_m(shadow_m: float, slant_range_m: float, altitude_m: float) -> float:
    """Return the height of an object from the length of its shadow, by similar triangles over a flat bottom.

    The ray over the top of the object meets the bottom at the end of the shadow. Height over shadow length therefore
    equals altitude over the slant range of the shadow's end.
    """
    return shadow_m * altitude_m / (slant_range_m + shadow_m)


def classify(length_m: float, width_m: float, height_m: float | None, settings: DetectorSettings) -> str:
    """Return "mine-like" for a contact with the size and shape of a mine, else "clutter".

    Mine-like: length, width and (if known) height are within the limits of the settings, and neither side of the
    highlight exceeds `mine_elongation` times the other. The class is about size only.
    """
    fits = (
        settings.mine_length_m[0] <= length_m <= settings.mine_length_m[1]
        and settings.mine_width_m[0] <= width_m <= settings.mine_width_m[1]
        and max(length_m, width_m) <= settings.mine_elongation * min(length_m, width_m)
        and (height_m is None or settings.mine_height_m[0] <= height_m <= settings.mine_height_m[1])
    )
    return MINE_LIKE if fits else CLUTTER


def _altitude_m(altitudes: FloatVector, grid: LevelGrid, row: int) -> float | None:
    """Return the altitude of the survey, else the slant range of the first bottom return; None if both are unknown."""
    altitude_m = float(altitudes[row])
    if altitude_m > 0:
        return altitude_m
    cell = int(grid.first_return_cell[row])
    return (cell + 0.5) * grid.cell_across_m if 0 < cell < grid.level.shape[1] else None
