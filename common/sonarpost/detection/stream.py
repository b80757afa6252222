"""Contacts of a survey line that is recorded in several files: what lies on the seam of two is found once, and whole.

A recorder begins a new file every so many pings, in the middle of whatever lies there. Contacts near a file's end are
held back; when the next file goes on where this one ended, the last pings of this one are put before it, so that the
filters see the seabed as it is, and the seam is looked at again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from sonarpost.detection.association import AssociationRule, DetectionPosition
from sonarpost.detection.detector import Detection, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.geometry import ping_spacing_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import Ping, Side, Survey

OVERLAP_M: Final = 40.0
"""How much of a file is put before the next: more than the filters look around."""
WITHHELD_M: Final = 6.0
"""Contacts this near to a file's end wait for the next file: the longest mine, its shadow and what is around it."""
_LONGEST_GAP_S: Final = 5.0
_LONGEST_GAP_PINGS: Final = 5.0


@dataclass(frozen=True, slots=True)
class StreamContact:
    """A contact of a line.

    Attributes:
        file: Number of the file that holds the ping of its middle, in the order of feeding, from 0.
        path: That file.
        ping: Index of that ping in that file.
        detection: The contact; its indices are those of `survey`.
        survey: The pings it was found in, and its snippets are to be cut from: one file's, or with the last ones of
            the files before it in front.
    """

    file: int
    path: Path
    ping: int
    detection: Detection
    survey: Survey

    def in_file(self) -> Detection:
        """Return the detection with the ping indices of its own file; the highlight may begin before its first."""
        shift = self.ping - self.detection.ping_index
        first, last = self.detection.highlight_pings
        return replace(self.detection, ping_index=self.ping, highlight_pings=(first + shift, last + shift))


@dataclass(frozen=True, slots=True)
class _Origin:
    file: int
    path: Path
    ping: int


@dataclass(frozen=True, slots=True)
class _Told:
    """A contact that was told, and its sample."""

    look: DetectionPosition
    sample: int


@dataclass(frozen=True, slots=True)
class _Tail:
    """The end of what was looked at.

    Attributes:
        survey: Its last pings, of one file or several.
        origins: For each of them its file's number and path, and its index there.
        held: Contacts near its end, not told yet.
        told: Those told; row 0 is its first ping.
    """

    survey: Survey
    origins: tuple[_Origin, ...]
    held: tuple[StreamContact, ...]
    told: tuple[_Told, ...]


class StreamDetector:
    """Detects file by file, in the order of recording.

    Args:
        settings: How to look; the defaults when None. A limit on contacts counts for each file, held ones included.
        options: The options the surveys were opened with; the defaults when None.
    """

    def __init__(self, settings: DetectorSettings | None = None, options: SurveyOptions | None = None) -> None:
        self._settings = settings if settings is not None else DetectorSettings()
        self._options = options if options is not None else SurveyOptions()
        # A contact is told only where it lies `WITHHELD_M` before the end, so that both looks see the same middle.
        self._sameness = AssociationRule(
            self._settings.separation_along_m, self._settings.separation_across_m, overlapping=False
        )
        self._tail: _Tail | None = None
        self._files = 0

    def feed(self, survey: Survey) -> tuple[StreamContact, ...]:
        """Look at the next file; return what is certain now, most confident first.

        That is the contacts of this file but those at its end, and those held back from the end of the file before.
        """
        before, self._tail = self._tail, None
        origins = tuple(_Origin(self._files, survey.path, row) for row in range(len(survey.pings)))
        self._files += 1
        released: tuple[StreamContact, ...] = ()
        known: tuple[_Told, ...] = ()
        first_row = 0
        if before is not None and follows(before.survey, survey):
            first_row = max(0, len(before.survey.pings) - self._pings(before.survey, WITHHELD_M))
            known = before.told
            survey = replace(survey, pings=before.survey.pings + survey.pings)
            origins = before.origins + origins
        elif before is not None:
            released = before.held
        found = [
            StreamContact(origins[d.ping_index].file, origins[d.ping_index].path, origins[d.ping_index].ping, d, survey)
            for d in detect(survey, self._settings, self._options)
            if d.ping_index >= first_row and not self._is_known(d, known)
        ]
        end = len(survey.pings) - self._pings(survey, WITHHELD_M)
        held = tuple(c for c in found if c.detection.ping_index >= end)
        told = tuple(c for c in found if c.detection.ping_index < end)
        self._tail = self._last_of(survey, origins, held, (*known, *(self._told(c.detection) for c in told)))
        return _in_order((*released, *told))

    def finish(self) -> tuple[StreamContact, ...]:
        """Return what was held back from the end of the last file: the line is over."""
        before, self._tail = self._tail, None
        return () if before is None else _in_order(before.held)

    def _last_of(
        self, survey: Survey, origins: tuple[_Origin, ...], held: tuple[StreamContact, ...], told: tuple[_Told, ...]
    ) -> _Tail:
        cut = max(0, len(survey.pings) - self._pings(survey, OVERLAP_M))
        kept = tuple(replace(each, look=each.look.moved(-cut)) for each in told if each.look.row >= cut)
        return _Tail(replace(survey, pings=survey.pings[cut:]), origins[cut:], held, kept)

    def _pings(self, survey: Survey, length_m: float) -> int:
        return math.ceil(length_m / (ping_spacing_m(survey) or self._settings.assumed_row_along_m))

    def _told(self, found: Detection) -> _Told:
        return _Told(DetectionPosition.of(found, unknown_along_m=self._settings.assumed_row_along_m), found.sample)

    def _is_known(self, found: Detection, known: Sequence[_Told]) -> bool:
        new = self._told(found)
        # Files of a line have the same samples: those between two contacts are counted.
        return any(
            self._sameness.holds(new.look, other.look, abs(new.sample - other.sample) * found.pixel_across_m)
            for other in known
        )


def follows(before: Survey, after: Survey) -> bool:
    """Return whether a file goes on where another ended: same sonar, same sampling, hardly any time between."""
    if not before.pings or not after.pings or before.sonar_id != after.sonar_id:
        return False
    last, first = before.pings[-1], after.pings[0]
    gap_s = first.time_utc_s - last.time_utc_s
    interval_s = (last.time_utc_s - before.pings[0].time_utc_s) / max(len(before.pings) - 1, 1)
    if not 0 <= gap_s <= max(_LONGEST_GAP_S if interval_s <= 0 else 0.0, _LONGEST_GAP_PINGS * interval_s):
        return False
    return _sampling(last) == _sampling(first)


def _sampling(ping: Ping) -> dict[Side, list[tuple[int, float]]]:
    """Return the samples and the range of each channel of a side, in their order: the first is the picture."""
    return {side: [(len(c.samples), c.slant_range_m) for c in ping.channels if c.side is side] for side in Side}


def _in_order(contacts: Sequence[StreamContact]) -> tuple[StreamContact, ...]:
    return tuple(sorted(contacts, key=lambda c: -c.detection.confidence))
