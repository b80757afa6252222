"""Detection of contacts in a survey: compact objects from the classifier, and large structures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from sonarpost.detection.candidates import (
    FilterScores,
    Measurement,
    PlacedCandidate,
    classified_candidates,
    distinct_candidates,
)
from sonarpost.detection.classifier import Classifier, default_classifier, load_classifier_once
from sonarpost.detection.difficulty import Difficulty, seabed_difficulty
from sonarpost.detection.matched_filter import matched_response
from sonarpost.detection.normalisation import FloatVector, LevelGrid, normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.structures import find_structures, find_water_structures, is_part_of_structure
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import Position, georeference, sample_slant_range_m, slant_to_ground_range_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import SurveySource, load_survey
from sonarpost.sonar.survey import Side, Survey

MINE_LIKE = "mine_like"
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
        confidence: 0 to 2: twice the probability of a mine-like object; of a structure, see `detection.structures`.
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
        position_note: Why the position may be wrong by more than that; None if nothing is known against it.
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
    position_note: str | None = None


LISTED_CONFIDENCES: Final = (1.0, 0.5, 0.3, 0.1)
"""Confidences below the threshold at which a search counts contacts."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of one search.

    Attributes:
        detections: Contacts of both sides at or above the confidence threshold, most confident first.
        weaker: What lower thresholds would give: for each of `LISTED_CONFIDENCES` below the threshold, the ping index
            of each contact at or above that confidence.
        difficulties: Difficulty of the seabed of each side; None where too little of it is known.
    """

    detections: tuple[Detection, ...]
    weaker: Mapping[float, tuple[int, ...]]
    difficulties: Mapping[Side, Difficulty | None] = field(default_factory=dict)


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
    settings = settings if settings is not None else DetectorSettings()
    return search(survey, settings, options if options is not None else SurveyOptions()).detections


def search(survey: Survey, settings: DetectorSettings, options: SurveyOptions) -> SearchResult:
    """Detect the contacts of a survey in memory, count those that lower thresholds would give, and rate the seabed.

    Args:
        survey: The recording.
        settings: `weaker` is not limited to the maximum number of contacts.
        options: As for `detect`.
    """
    classifier = classifier_of(settings)
    altitude_m = altitudes_m(survey)
    found: list[Detection] = []
    weaker: dict[float, list[int]] = {c: [] for c in LISTED_CONFIDENCES if c < settings.confidence_threshold}
    difficulties: dict[Side, Difficulty | None] = {}
    for side in survey.sides():
        grid = normalise_side(survey, side, settings, altitude_m)
        if grid is None:
            difficulties[side] = None
            continue
        contacts = _SideContacts(grid, settings, classifier, min((settings.confidence_threshold, *weaker)))
        difficulties[side] = seabed_difficulty(grid, contacts.matched, settings.confidence_threshold)
        for confidence, rows in weaker.items():
            places = [contact.measurement.row for contact in contacts.at(confidence)]
            rows += [row for row in places if survey.pings[row].channel(side) is not None]
        for contact in contacts.at(settings.confidence_threshold):
            detection = detection_of(survey, grid, contact, options, altitude_m)
            found += [detection] if detection is not None else []
    found.sort(key=lambda d: (-d.confidence, d.ping_index, d.side.value, d.sample))
    lower = {c: tuple(rows) for c, rows in weaker.items()}
    return SearchResult(tuple(found[: settings.max_contacts]), lower, difficulties)


@dataclass(frozen=True, slots=True)
class GridContact:
    """A contact in grid cells.

    Attributes:
        confidence: 0 to 2.
        measurement: Its highlight and shadow.
        atd_class: Class of the detection.
        p_mine_like: Probability of a mine-like object; None for a structure, which is not classified.
        p_other_object: Probability of another object; None for a structure.
    """

    confidence: float
    measurement: Measurement
    atd_class: str
    p_mine_like: float | None = None
    p_other_object: float | None = None


class _SideContacts:
    """The contacts of one side at any threshold down to `lowest`."""

    def __init__(self, grid: LevelGrid, settings: DetectorSettings, classifier: Classifier, lowest: float) -> None:
        response = matched_response(grid, settings)
        candidates = classified_candidates(response, grid, settings, classifier)
        self.matched = [candidate.peak.score for candidate in candidates]
        # Only more confident candidates suppress one: those at a higher threshold are the first of this list.
        self._kept = [_compact(c) for c in distinct_candidates(candidates, grid, settings, lowest)]
        structures = (*find_structures(grid), *find_water_structures(grid))
        self._structures = [GridContact(s.confidence, s.measurement, STRUCTURE) for s in structures]
        self._grid = grid

    def at(self, threshold: float) -> list[GridContact]:
        """Return each contact at or above a threshold.

        A contact that is part of a more confident structure is not reported.
        """
        kept: list[GridContact] = []
        for contact in sorted((*self._kept, *self._structures), key=lambda c: -c.confidence):
            if contact.confidence < threshold:
                break
            structures = (other for other in kept if other.atd_class == STRUCTURE)
            if not any(is_part_of_structure(contact.measurement, s.measurement, self._grid) for s in structures):
                kept.append(contact)
        return kept


def _compact(placed: PlacedCandidate) -> GridContact:
    candidate = placed.candidate
    atd_class = MINE_LIKE if candidate.p_mine_like >= candidate.p_other_object else CLUTTER
    p_mine_like, p_other_object = round(candidate.p_mine_like, 4), round(candidate.p_other_object, 4)
    return GridContact(candidate.confidence, placed.measurement, atd_class, p_mine_like, p_other_object)


def detection_of(
    survey: Survey,
    grid: LevelGrid,
    contact: GridContact,
    options: SurveyOptions,
    altitudes: FloatVector,
) -> Detection | None:
    """Convert a contact from grid cells to metres and positions; None if its ping has no such channel."""
    measurement = contact.measurement
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
        confidence=contact.confidence,
        scores=measurement.scores,
        atd_class=contact.atd_class,
        pixel_along_m=grid.row_along_m if grid.row_is_measured else None,
        pixel_across_m=across_m,
        highlight_pings=measurement.rows,
        highlight_samples=samples,
        shadow_samples=measurement.shadow_cells * grid.samples_per_cell,
        position_sigma_m=None if reference is None else reference.sigma_m,
        p_mine_like=contact.p_mine_like,
        p_other_object=contact.p_other_object,
        position_note=ping.position_note,
    )


def height_from_shadow_m(shadow_m: float, slant_range_m: float, altitude_m: float) -> float:
    """Return the height of an object from the length of its shadow, by similar triangles over a flat bottom.

    The ray over the top of the object meets the bottom at the end of the shadow. Height over shadow length therefore
    equals altitude over the slant range of the shadow's end.
    """
    return shadow_m * altitude_m / (slant_range_m + shadow_m)


def classifier_of(settings: DetectorSettings) -> Classifier:
    """Return the classifier of the settings: that of their file, else the default one.

    Raises:
        ConfigError: The file cannot be read, or does not have the identity of the settings.
    """
    if settings.classifier is None:
        return default_classifier()
    return load_classifier_once(Path(settings.classifier), settings.classifier_identity)


def _altitude_m(altitudes: FloatVector, grid: LevelGrid, row: int) -> float | None:
    """Return the altitude of the survey, else the slant range of the first bottom return; None if both are unknown."""
    altitude_m = float(altitudes[row])
    if altitude_m > 0:
        return altitude_m
    cell = int(grid.first_return_cell[row])
    return (cell + 0.5) * grid.cell_across_m if 0 < cell < grid.level.shape[1] else None
