"""From a survey to the contacts worth sending."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sonarpost.detection.candidates import Candidate, FilterScores, candidates
from sonarpost.detection.fusion import fused_confidences, suppress
from sonarpost.detection.normalisation import FloatVector, LevelGrid, preprocess
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.structures import is_within, structures
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import Position, georeference, sample_slant_range_m, slant_to_ground_range_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import Side, Survey

MINE_LIKE = "mine-like"
CLUTTER = "clutter"


@dataclass(frozen=True, slots=True)
class Detection:
    """One contact, as the detector found it. A value that the survey does not tell is None.

    Attributes:
        side: The side it was seen on.
        ping_index: Index into `Survey.pings` of the highlight's middle.
        ping_number: The file's number of that ping.
        sample: Sample index of the highlight's middle in that ping's channel (0 is nearest the vehicle).
        time_utc_s: Time of that ping, seconds since 1970-01-01 UTC.
        vehicle: Where the vehicle was.
        position: Where the object lies: abeam of the vehicle at the ground range.
        heading_deg: The vehicle's heading, 0 to 360 (360 not included).
        altitude_m: The vehicle's height over the bottom: the file's, else from the first bottom return.
        depth_m: The vehicle's depth.
        speed_mps: The vehicle's speed.
        slant_range_m: Slant range to the highlight's middle.
        ground_range_m: The same on a flat bottom.
        length_m: Extent of the highlight along-track; None when the travel between pings is not known.
        width_m: Extent of the highlight across-track, on the slant-range picture.
        shadow_m: Length of the shadow on the slant-range picture, from the highlight's outer edge.
        height_m: shadow x altitude / (slant range + shadow), by similar triangles over a flat bottom.
        shadow_is_cut: True when the recording ends before the shadow; `shadow_m` and `height_m` are then lower bounds.
        confidence: 0 to 2, see `sonarpost.detection.fusion`.
        scores: The filters' own scores.
        atd_class: "mine-like" or "clutter", see `classify`.
        pixel_along_m: Travel between two pings.
        pixel_across_m: Slant range of one sample.
        highlight_pings: First and one-past-last ping index of the highlight.
        highlight_samples: First and one-past-last sample of the highlight.
        shadow_samples: Length of the shadow in samples.
        position_sigma_m: Root mean square distance of the true place from `position`, from the error budget of the
            survey's options; None where there is no position.
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


def detect(
    survey: Survey, settings: DetectorSettings | None = None, options: SurveyOptions | None = None
) -> tuple[Detection, ...]:
    """Find the contacts of a survey.

    Args:
        survey: The recording; pings of both sides, any sample type.
        settings: How to look; the defaults when None.
        options: The options the survey was opened with, for the errors of position, heading and altitude; the
            defaults when None.

    Returns:
        The contacts of both sides whose confidence reaches the threshold, most confident first. Empty for a survey
        without samples.
    """
    chosen = settings if settings is not None else DetectorSettings()
    altitude_m = altitudes_m(survey)
    known = options if options is not None else SurveyOptions()
    found = [d for side in survey.sides() for d in _detect_side(survey, side, chosen, known, altitude_m)]
    found.sort(key=lambda d: (-d.confidence, d.ping_index, d.side.value, d.sample))
    return tuple(found[: chosen.max_contacts])


def _detect_side(
    survey: Survey, side: Side, settings: DetectorSettings, options: SurveyOptions, altitude_m: FloatVector
) -> list[Detection]:
    grid = preprocess(survey, side, settings, altitude_m)
    if grid is None:
        return []
    kept = suppress(_scored(grid, settings), grid, settings)
    # What lies within a structure and is plainer than it has its contact already.
    for structure in structures(grid):
        if structure.confidence < settings.confidence_threshold:
            break
        if not any(is_within(other, structure.candidate, grid) for _, other in kept):
            kept.append((structure.confidence, structure.candidate))
    described = [_describe(survey, grid, confidence, one, settings, options, altitude_m) for confidence, one in kept]
    return [d for d in described if d is not None]


def _scored(grid: LevelGrid, settings: DetectorSettings) -> list[tuple[float, Candidate]]:
    """Return the places of a grid whose confidence reaches the threshold."""
    found = candidates(grid, settings)
    scored = zip(fused_confidences(found, grid, settings), found, strict=True)
    return [c for c in scored if c[0] >= settings.confidence_threshold]


def _describe(
    survey: Survey,
    grid: LevelGrid,
    confidence: float,
    candidate: Candidate,
    settings: DetectorSettings,
    options: SurveyOptions,
    altitudes: FloatVector,
) -> Detection | None:
    measured = candidate.measured
    ping = survey.pings[measured.row]
    channel = ping.channel(grid.side)
    if channel is None:
        return None
    across_m = channel.sample_spacing_m
    samples = (measured.cells[0] * grid.samples_per_cell, measured.cells[1] * grid.samples_per_cell)
    sample = min((samples[0] + samples[1]) // 2, channel.samples.shape[0] - 1)
    slant_m = sample_slant_range_m(channel, sample)
    altitude_m = _altitude_m(altitudes, grid, measured.row)
    ground_m = float(slant_to_ground_range_m(slant_m, altitude_m)) if altitude_m is not None else math.nan
    length_m = (measured.rows[1] - measured.rows[0]) * grid.row_along_m
    width_m = (samples[1] - samples[0]) * across_m
    shadow_m = measured.shadow_cells * grid.samples_per_cell * across_m
    height_m = height_from_shadow_m(shadow_m, slant_m, altitude_m) if altitude_m is not None else None
    place = georeference(ping, grid.side, sample, options, tracked_altitude_m=altitude_m)
    has_fix = ping.lat_deg is not None and ping.lon_deg is not None
    return Detection(
        side=grid.side,
        ping_index=measured.row,
        ping_number=ping.number,
        sample=sample,
        time_utc_s=ping.time_utc_s,
        vehicle=Position(ping.lat_deg, ping.lon_deg) if has_fix else None,  # type: ignore[arg-type]
        position=None if place is None else place.position,
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
        shadow_is_cut=measured.shadow_is_cut,
        confidence=confidence,
        scores=candidate.scores,
        atd_class=classify(length_m, width_m, height_m, settings),
        pixel_along_m=grid.row_along_m if grid.row_is_measured else None,
        pixel_across_m=across_m,
        highlight_pings=measured.rows,
        highlight_samples=samples,
        shadow_samples=measured.shadow_cells * grid.samples_per_cell,
        position_sigma_m=None if place is None else place.drms_m,
    )


def height_from_shadow_m(shadow_m: float, slant_range_m: float, altitude_m: float) -> float:
    """Return the height of an object from its shadow, by similar triangles over a flat bottom.

    The ray that grazes the object's top meets the bottom at the shadow's end, so that height over shadow equals
    altitude over the slant range of the shadow's end.
    """
    return shadow_m * altitude_m / (slant_range_m + shadow_m)


def classify(length_m: float, width_m: float, height_m: float | None, settings: DetectorSettings) -> str:
    """Return "mine-like" for a contact of a mine's size and shape, else "clutter".

    Mine-like: the highlight's length and width and the height (where known) lie within the settings' limits, and the
    highlight is not longer than `mine_elongation` times its width (nor the other way round). It is a statement about
    size, not about what the object is.
    """
    fits = (
        settings.mine_length_m[0] <= length_m <= settings.mine_length_m[1]
        and settings.mine_width_m[0] <= width_m <= settings.mine_width_m[1]
        and max(length_m, width_m) <= settings.mine_elongation * min(length_m, width_m)
        and (height_m is None or settings.mine_height_m[0] <= height_m <= settings.mine_height_m[1])
    )
    return MINE_LIKE if fits else CLUTTER


def _altitude_m(altitudes: FloatVector, grid: LevelGrid, row: int) -> float | None:
    """The survey's altitude, else the slant range of this side's first bottom return; None where neither is known."""
    given = float(altitudes[row])
    if given > 0:
        return given
    cell = int(grid.first_return_cell[row])
    return (cell + 0.5) * grid.cell_across_m if 0 < cell < grid.level.shape[1] else None
