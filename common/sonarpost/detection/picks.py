"""Picks: places in a recording that a person marks as contacts, whether or not the detector has found them.

A pick is measured like a detection. If the detector has a contact there at a confidence of 0.1 or more, the contact is
that one, with its confidence and class. Otherwise highlight and shadow are measured at the pick; the contact has the
class "picked" and no confidence. If nothing can be measured, its sizes are unknown too.

`SURVEY.picks` beside a survey file contains one pick a line, `ping,side,sample`. Empty lines and lines that begin with
`#` are ignored.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from typing_extensions import override

from sonarpost.detection.candidates import FilterScores, Measurement, measure
from sonarpost.detection.detector import (
    LISTED_CONFIDENCES,
    STRUCTURE,
    Detection,
    GridContact,
    detection_of,
    search,
)
from sonarpost.detection.matched_filter import MatchedResponse, Peak, highlight_size_cells, matched_response
from sonarpost.detection.normalisation import LevelGrid, normalise_side
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import STRIP_PINGS, FileOrigin, PingOrigin, contact_record
from sonarpost.errors import ConfigError
from sonarpost.messages import Contact
from sonarpost.sonar.bottom_track import altitudes_m
from sonarpost.sonar.geometry import ping_spacing_m
from sonarpost.sonar.source import Strip, SurveySource, strips
from sonarpost.sonar.survey import Side, Survey

PICKED: Final = "picked"
"""Class of a contact that a person picked and the detector has no candidate for."""
PICKS_SUFFIX: Final = ".picks"
MAX_PICKS: Final = 1000
MAX_PICKS_BYTES: Final = 1 << 16
_SYNTAX: Final = "PING,SIDE,SAMPLE, for example 1120,port,300"
_INDEX: Final = "index:"
_NUMBER: Final = re.compile(r"[0-9]{1,18}")
_NEAR_M: Final = 0.3
"""A pick this near to the highlight or shadow of a candidate is on that candidate."""
_SNAP_M: Final = 0.5
"""A highlight is measured at the best response of the matched filter within this distance of the pick."""
_MIN_HIGHLIGHT: Final = 1.0
"""Minimum level of a measurable highlight above the seabed around it, in robust deviations."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Pick:
    """A place in a recording.

    Attributes:
        ping: Number of the ping in the file, column `ping` of the table of `sonarpost detect`; or with `by_index` its
            index in the file from 0, field `ping` of `sonarpost detect --json`.
        side: Port or starboard.
        sample: Index of the sample in that ping's channel, 0 nearest the vehicle.
        by_index: Whether `ping` is an index. Needed where a file repeats ping numbers.
    """

    ping: int
    side: Side
    sample: int
    by_index: bool = False

    @override
    def __str__(self) -> str:
        return f"{_INDEX if self.by_index else ''}{self.ping},{self.side.value},{self.sample}"


def parse_pick(text: str, where: str) -> Pick:
    """Return the pick of `ping,side,sample` or `index:ping,side,sample`.

    Args:
        text: The pick; spaces around its parts are ignored.
        where: Source of the text, for errors.

    Raises:
        ConfigError: The text is not a pick.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 3:
        raise ConfigError(where, "place", text, _SYNTAX)
    ping, side, sample = parts
    by_index = ping.startswith(_INDEX)
    ping = ping.removeprefix(_INDEX)
    for name, part in (("ping", ping), ("sample", sample)):
        if not _NUMBER.fullmatch(part):
            raise ConfigError(where, name, part, "a whole number, 0 or more")
    if side not in tuple(Side):
        raise ConfigError(where, "side", side, " or ".join(Side))
    return Pick(int(ping), Side(side), int(sample), by_index)


def picks_path(survey: Path) -> Path:
    """Return the path of the picks of a survey file: its name with `.picks` appended."""
    return survey.with_name(survey.name + PICKS_SUFFIX)


def picks_text(picks: Iterable[Pick]) -> str:
    """Return the content of a file of picks."""
    return "".join(f"{pick}\n" for pick in picks)


def parse_picks(content: bytes, where: str) -> tuple[tuple[Pick, ...], tuple[ConfigError, ...]]:
    """Return the picks of a file without repetitions, and an error for each invalid line.

    Args:
        content: The file.
        where: Its name, for errors.
    """
    if len(content) > MAX_PICKS_BYTES:
        return (), (ConfigError(where, "size", len(content), f"at most {MAX_PICKS_BYTES} bytes"),)
    picks: dict[Pick, None] = {}
    errors = []
    for number, raw in enumerate(content.decode("utf-8-sig", "backslashreplace").splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        if len(picks) == MAX_PICKS:
            errors.append(ConfigError(f"{where} line {number}", "picks", "one more", f"at most {MAX_PICKS}"))
            break
        try:
            picks[parse_pick(line, f"{where} line {number}")] = None
        except ConfigError as error:
            errors.append(error)
    return tuple(picks), tuple(errors)


@dataclass(frozen=True, slots=True)
class LocatedPick:
    """A pick that the recording contains, with the row of its ping in the file."""

    pick: Pick
    row: int


def locate_picks(
    source: SurveySource, picks: Sequence[Pick], where: str
) -> tuple[tuple[LocatedPick, ...], tuple[ConfigError, ...]]:
    """Find the pings of picks: one pass through the file, with constant memory.

    Args:
        source: The recording.
        picks: The picks.
        where: Source of the picks, for errors.

    Returns:
        The picks that the recording contains, in their order, and an error for each other one.

    Raises:
        SurveyFileError: The file cannot be read.
    """
    numbers = {pick.ping for pick in picks if not pick.by_index}
    indices = {pick.ping for pick in picks if pick.by_index}
    rows_by_number: dict[int, list[int]] = {}
    samples: dict[tuple[int, Side], int] = {}
    low = high = -1
    for row, ping in enumerate(source.pings()):
        low, high = (min(low, ping.number), max(high, ping.number)) if row else (ping.number, ping.number)
        if ping.number in numbers:
            found = rows_by_number.setdefault(ping.number, [])
            if len(found) == 2:
                continue  # two are enough to know that it is ambiguous
            found.append(row)
        elif row not in indices:
            continue
        for side in Side:
            channel = ping.channel(side)
            samples[row, side] = 0 if channel is None else len(channel.samples)
    located = []
    errors = []
    for pick in picks:
        rows = [pick.ping] if pick.by_index else rows_by_number.get(pick.ping, [])
        count = samples.get((rows[0], pick.side)) if rows else None
        if count is None:
            last = source.info.ping_count - 1
            expected = f"an index from 0 to {last}" if pick.by_index else f"a ping number of the file, {low} to {high}"
            errors.append(ConfigError(where, "ping", pick.ping, expected))
        elif len(rows) > 1:
            expected = f"a ping number that occurs once; `{_INDEX}{rows[0]}` is the first ping with it"
            errors.append(ConfigError(where, "ping", pick.ping, expected))
        elif not count:
            expected = "a side on which this ping has a channel"
            errors.append(ConfigError(where, "side", pick.side.value, expected))
        elif pick.sample >= count:
            errors.append(ConfigError(where, "sample", pick.sample, f"0 to {count - 1}"))
        else:
            located.append(LocatedPick(pick, rows[0]))
    return tuple(located), tuple(errors)


@dataclass(frozen=True, slots=True)
class PickedDetection:
    """The detection at a pick.

    Attributes:
        detection: As the detector returns it. Without a candidate its class is `PICKED` and its confidence 0.
        is_candidate: Whether the detector has a candidate there.
        is_measured: Whether the sizes are measured; otherwise those of `detection` are those of one sample.
    """

    detection: Detection
    is_candidate: bool
    is_measured: bool

    def record(self, origin: FileOrigin, vehicle_id: str, sonar_id: str) -> Contact:
        """Return the contact record, in which unknown sizes and the confidence of a person's pick are None."""
        record = contact_record(self.detection, origin, vehicle_id, sonar_id)
        unknown = [] if self.is_candidate else ["atd_confidence"]
        if not self.is_measured:
            unknown += ["length_m", "width_m", "shadow_m", "height_m"]
        return record.model_copy(update=dict.fromkeys(unknown))


DescribePick = Callable[[Survey, PickedDetection, PingOrigin], T]
"""Makes what the caller needs of a pick, from pings around it, the detection in them, and the origin of its ping."""


def measure_picks(
    source: SurveySource,
    origin: FileOrigin,
    picks: Sequence[LocatedPick],
    describe: DescribePick[T],
    settings: DetectorSettings,
) -> list[T]:
    """Measure picks, each within a strip of pings around it; only strips with picks are searched.

    Args:
        source: The recording.
        origin: Its file.
        picks: The picks in this recording.
        describe: Called for each pick, while the pings around it are in memory.
        settings: Settings of the detector; threshold and maximum number of contacts are not applied.

    Returns:
        What `describe` returned, in the order of `picks`.

    Raises:
        SurveyFileError: The file cannot be read.
    """
    overlap = settings.join_overlap_pings
    described: dict[int, T] = {}
    first_open = 0
    for strip in strips(source.pings(), max(STRIP_PINGS, 2 * overlap), overlap):
        end = strip.first_row + len(strip.pings)
        # As the detector does: of an overlap, each strip decides about the half of which it shows more seabed.
        behind = end if strip.is_last else end - overlap // 2
        here = [(n, each) for n, each in enumerate(picks) if first_open <= each.row < behind]
        first_open = behind
        if here:
            measured = _StripPicks(source, strip, settings)
            for number, each in here:
                picked = measured.at(each)
                row = strip.first_row + picked.detection.ping_index
                described[number] = describe(measured.survey, picked, PingOrigin(origin, row))
    return [described[number] for number in range(len(picks))]


def is_at_detection(detection: Detection, row: int, pick: Pick, settings: DetectorSettings) -> bool:
    """Return whether a pick is on a detection: on highlight or shadow, or within 0.3 m of them.

    On a structure, which may be longer than a snippet, the centre must also be within `separation_along_m` and
    `separation_across_m` of the pick.

    Args:
        detection: The detection.
        row: Row of the pick, counted like `detection.ping_index`.
        pick: The pick.
        settings: Settings of the detector.
    """
    d = detection
    if d.side is not pick.side:
        return False
    along_m = d.pixel_along_m if d.pixel_along_m is not None else settings.assumed_row_along_m
    rows, samples = _NEAR_M / along_m, _NEAR_M / d.pixel_across_m
    first_row, end_row = d.highlight_pings
    first, end = d.highlight_samples[0], d.highlight_samples[1] + d.shadow_samples
    if not (first_row - rows <= row < end_row + rows and first - samples <= pick.sample < end + samples):
        return False
    is_near = (
        abs(row - d.ping_index) * along_m < settings.separation_along_m
        and abs(pick.sample - d.sample) * d.pixel_across_m < settings.separation_across_m
    )
    return is_near or d.atd_class != STRUCTURE


class _StripPicks:
    """The picks of one strip; its search and level grids are computed when they are needed, once."""

    def __init__(self, source: SurveySource, strip: Strip, settings: DetectorSettings) -> None:
        info = source.info
        self.survey = Survey(info.path, info.sonar_id, info.line_name, strip.pings, info.warnings)
        self._options = source.options
        self._first_row = strip.first_row
        self._settings = settings
        lowest = settings.model_copy(update={"confidence_threshold": min(LISTED_CONFIDENCES), "max_contacts": None})
        self._candidates = search(self.survey, lowest, source.options).detections
        self._altitudes_m = altitudes_m(self.survey)
        self._sides: dict[Side, tuple[LevelGrid, MatchedResponse] | None] = {}

    def at(self, located: LocatedPick) -> PickedDetection:
        """Return the detection at a pick: the most confident candidate, else what can be measured there."""
        pick, row = located.pick, located.row - self._first_row
        for candidate in self._candidates:  # most confident first
            if is_at_detection(candidate, row, pick, self._settings):
                return PickedDetection(candidate, is_candidate=True, is_measured=True)
        if pick.side not in self._sides:
            grid = normalise_side(self.survey, pick.side, self._settings, self._altitudes_m)
            self._sides[pick.side] = None if grid is None else (grid, matched_response(grid, self._settings))
        side = self._sides[pick.side]
        place = None if side is None else _measured_at(*side, row, pick.sample, self._settings)
        found = None if side is None or place is None else self._detection(side[0], place)
        is_measured = found is not None
        if found is None:
            found = self._detection(*self._single_sample(row, pick))
        assert found is not None, "the ping of a located pick has this channel"
        return PickedDetection(found, is_candidate=False, is_measured=is_measured)

    def _detection(self, grid: LevelGrid, measurement: Measurement) -> Detection | None:
        """Return a measurement as a detection; None if the ping of its centre has no such channel."""
        contact = GridContact(0.0, measurement, PICKED)
        return detection_of(self.survey, grid, contact, self._options, self._altitudes_m)

    def _single_sample(self, row: int, pick: Pick) -> tuple[LevelGrid, Measurement]:
        """Return a grid of the samples themselves, and the one at the pick as a measurement without a shadow."""
        channel = self.survey.pings[row].channel(pick.side)
        assert channel is not None, "the ping of a located pick has this channel"
        spacing_m = ping_spacing_m(self.survey)
        pings = len(self.survey.pings)
        grid = LevelGrid(
            side=pick.side,
            level=np.broadcast_to(np.float32(np.nan), (pings, len(channel.samples))),
            first_return_cell=np.zeros(pings, dtype=np.int64),
            samples_per_cell=1,
            cell_across_m=channel.sample_spacing_m,
            row_along_m=spacing_m if spacing_m is not None else self._settings.assumed_row_along_m,
            row_is_measured=spacing_m is not None,
        )
        place = Measurement(
            row=row,
            cell=pick.sample,
            rows=(row, row + 1),
            cells=(pick.sample, pick.sample + 1),
            shadow_cells=0,
            shadow_is_cut=False,
            scores=FilterScores(0.0, 0.0, 0.0),
        )
        return grid, place


def _measured_at(
    grid: LevelGrid, response: MatchedResponse, row: int, sample: int, settings: DetectorSettings
) -> Measurement | None:
    """Return highlight and shadow near a place of one side of a strip; None if they cannot be measured.

    Nothing is measured where the highlight does not exceed the seabed around it, or where its centre is farther
    from the pick than the centres of one contact are from each other.
    """
    cell = sample // grid.samples_per_cell
    peak = _peak_near(grid, response, row, cell, settings)
    measurement = None if peak is None else measure(grid, peak, settings)
    if measurement is None or measurement.scores.cfar < _MIN_HIGHLIGHT:
        return None
    along_m = abs(measurement.row - row) * grid.row_along_m
    across_m = abs(measurement.cell - cell) * grid.cell_across_m
    is_near = along_m < settings.separation_along_m and across_m < settings.separation_across_m
    return measurement if is_near else None


def _peak_near(
    grid: LevelGrid, response: MatchedResponse, row: int, cell: int, settings: DetectorSettings
) -> Peak | None:
    """Return the place of the best response of the matched filter near a cell; None in the water column."""
    reach_rows, reach_cells = (math.ceil(_SNAP_M / each) for each in (grid.row_along_m, grid.cell_across_m))
    top, left = max(row - reach_rows, 0), max(cell - reach_cells, 0)
    window = np.s_[top : row + reach_rows + 1, left : cell + reach_cells + 1]
    known = np.isfinite(grid.level[window])
    if not known.any():
        return None
    score = np.where(known, response.score[window], -1.0)
    best_row, best_cell = (int(each) for each in np.unravel_index(int(np.argmax(score)), score.shape))
    best = float(score[best_row, best_cell])
    if best <= 0.0:
        # No response: the nearest known cell.
        rows, cells = np.nonzero(known)
        nearest = int(np.argmin(np.abs(rows + top - row) + np.abs(cells + left - cell)))
        best_row, best_cell, best = int(rows[nearest]), int(cells[nearest]), 0.0
    best_row, best_cell = top + best_row, left + best_cell
    index = int(response.highlight_index[best_row, best_cell])
    return Peak(best_row, best_cell, best, *highlight_size_cells(grid, settings.highlight_sizes_m[index]))
