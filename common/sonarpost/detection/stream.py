"""Detection in a survey line that is recorded in several files. An object at a file boundary is detected once.

A recorder starts a new file after a number of pings, possibly in the middle of an object. The detector holds contacts
near the end of a file back. If the next file continues the line, its pings are processed together with the last pings
of the file before, so that the filters have the seabed on both sides of the boundary.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

from sonarpost.detection.association import DetectionPosition
from sonarpost.detection.detector import Detection, search
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.geometry import ping_spacing_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import Ping, Side, Survey

OVERLAP_M: Final = 40.0
"""Length of the file end that is processed together with the next file: more than the reach of the filters."""
HELD_BACK_M: Final = 6.0
"""Contacts this near to the end of a file wait for the next one: the longest mine, its shadow and its surroundings."""
_MAX_GAP_S: Final = 5.0
_MAX_GAP_PINGS: Final = 5.0


@dataclass(frozen=True, slots=True)
class StreamContact:
    """A contact of a line.

    Attributes:
        file: Number of the file that contains the ping of its centre, from 0 in order of processing.
        path: That file.
        ping: Index of that ping in that file.
        detection: The contact; its indices refer to `survey`.
        survey: The pings in which it was detected, for its snippets: those of one file, or with the last pings of
            earlier files first.
    """

    file: int
    path: Path
    ping: int
    detection: Detection
    survey: Survey

    def in_file(self) -> Detection:
        """Return the detection with ping indices of its own file; the highlight may begin before its first ping."""
        shift = self.ping - self.detection.ping_index
        first, last = self.detection.highlight_pings
        return replace(self.detection, ping_index=self.ping, highlight_pings=(first + shift, last + shift))


class _Origin(NamedTuple):
    file: int
    path: Path
    ping: int


@dataclass(frozen=True, slots=True)
class _FileEnd:
    """The end of the pings processed so far.

    Attributes:
        survey: The last pings, of one file or several.
        origins: File number, path and index in that file of each of them.
        held: Contacts held back near the end.
        reported: Places of the contacts returned already; row 0 is the first ping of `survey`.
    """

    survey: Survey
    origins: tuple[_Origin, ...]
    held: tuple[StreamContact, ...]
    reported: tuple[DetectionPosition, ...]


class StreamDetector:
    """Detects file by file, in the order of recording.

    Args:
        settings: None for the defaults. The maximum number of contacts applies to each file, held ones included.
        options: The options with which the surveys were opened; None for the defaults.
    """

    def __init__(self, settings: DetectorSettings | None = None, options: SurveyOptions | None = None) -> None:
        self._settings = settings if settings is not None else DetectorSettings()
        self._options = options if options is not None else SurveyOptions()
        self._end: _FileEnd | None = None
        self._files = 0
        self.weaker: list[dict[float, int]] = []
        """For each file, the number of contacts at the confidences of `LISTED_CONFIDENCES` below the threshold."""

    def add_file(self, survey: Survey) -> tuple[StreamContact, ...]:
        """Process the next file.

        Returns:
            The contacts of this file except those near its end, and those held back from the file before, most
            confident first.
        """
        before, self._end = self._end, None
        origins = tuple(_Origin(self._files, survey.path, row) for row in range(len(survey.pings)))
        self._files += 1
        released: tuple[StreamContact, ...] = ()
        reported: tuple[DetectionPosition, ...] = ()
        first_row = new_row = 0
        if before is not None and is_continuation(before.survey, survey):
            first_row = max(0, len(before.survey.pings) - self._pings(before.survey, HELD_BACK_M))
            reported = before.reported
            survey = replace(survey, pings=before.survey.pings + survey.pings)
            origins = before.origins + origins
            new_row = len(before.survey.pings)
        elif before is not None:
            released = before.held
        result = search(survey, self._settings, self._options)
        self.weaker.append({c: sum(row >= new_row for row in rows) for c, rows in result.weaker.items()})
        found = [
            StreamContact(*origins[d.ping_index], d, survey)
            for d in result.detections
            if d.ping_index >= first_row and not self._is_reported(d, reported)
        ]
        end = len(survey.pings) - self._pings(survey, HELD_BACK_M)
        held = tuple(c for c in found if c.detection.ping_index >= end)
        final = tuple(c for c in found if c.detection.ping_index < end)
        self._end = self._end_of(survey, origins, held, (*reported, *(self._place(c.detection) for c in final)))
        return _by_confidence((*released, *final))

    def finish(self) -> tuple[StreamContact, ...]:
        """End the line; return the contacts held back from the last file."""
        before, self._end = self._end, None
        return () if before is None else _by_confidence(before.held)

    def _end_of(
        self,
        survey: Survey,
        origins: tuple[_Origin, ...],
        held: tuple[StreamContact, ...],
        reported: tuple[DetectionPosition, ...],
    ) -> _FileEnd:
        cut = max(0, len(survey.pings) - self._pings(survey, OVERLAP_M))
        kept = tuple(place.shifted(-cut) for place in reported if place.row >= cut)
        return _FileEnd(replace(survey, pings=survey.pings[cut:]), origins[cut:], held, kept)

    def _pings(self, survey: Survey, length_m: float) -> int:
        return math.ceil(length_m / (ping_spacing_m(survey) or self._settings.assumed_row_along_m))

    def _place(self, detection: Detection) -> DetectionPosition:
        return DetectionPosition.of_detection(detection, default_along_m=self._settings.assumed_row_along_m)

    def _is_reported(self, detection: Detection, reported: Sequence[DetectionPosition]) -> bool:
        # A contact is returned only if it lies `HELD_BACK_M` before the end: both detections then have the same centre.
        new, limits_m = self._place(detection), (self._settings.separation_along_m, self._settings.separation_across_m)
        return any(new.is_near(place, *limits_m) for place in reported)


def is_continuation(before: Survey, after: Survey) -> bool:
    """Return whether a file continues another: same sonar, same sampling, a gap of a few pings at most."""
    if not before.pings or not after.pings or before.sonar_id != after.sonar_id:
        return False
    last, first = before.pings[-1], after.pings[0]
    gap_s = first.time_utc_s - last.time_utc_s
    interval_s = (last.time_utc_s - before.pings[0].time_utc_s) / max(len(before.pings) - 1, 1)
    if not 0 <= gap_s <= max(_MAX_GAP_S if interval_s <= 0 else 0.0, _MAX_GAP_PINGS * interval_s):
        return False
    return _sampling(last) == _sampling(first)


def _sampling(ping: Ping) -> dict[Side, list[tuple[int, float]]]:
    """Return sample count and slant range of each channel of a side, in their order."""
    return {side: [(len(c.samples), c.slant_range_m) for c in ping.channels if c.side is side] for side in Side}


def _by_confidence(contacts: Sequence[StreamContact]) -> tuple[StreamContact, ...]:
    return tuple(sorted(contacts, key=lambda c: -c.detection.confidence))
