"""Looks for contacts in a survey file of any length, together with the end of the file before it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from typing import Final

from sonarpost import wire
from sonarpost.detection.detector import Detection, detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.record import of_detection
from sonarpost.services.atd_stub.seam import Origin, Seam, SeamLook, last_pings
from sonarpost.sonar.source import Strip, SurveySource, strips
from sonarpost.sonar.survey import Ping, Survey

STRIP_PINGS: Final = 1000
_TOLERANCE_PINGS: Final = 15
"""Two looks at an object may place its middle so far from each other."""
_MOST_COMPARED: Final = 2000


@dataclass(frozen=True, slots=True)
class Finding:
    """What a file gave.

    Attributes:
        snippets: Contacts that are ready, most confident first.
        contacts: How many contacts were found that were not known, those that are held included.
        seam: The file's end with what is held there; None where no seam is kept.
        joined: The file went on where the one before it ended.
        warnings: What the reader met and could explain.
    """

    snippets: tuple[Snippet, ...]
    contacts: int
    seam: Seam | None = None
    joined: bool = False
    warnings: tuple[str, ...] = ()


@dataclass(slots=True)
class _Found:
    look: SeamLook
    snippet: Snippet
    is_new: bool


class SurveyWalk:
    """One walk through a file, for `run` once.

    The file is read in strips that overlap, so that memory does not depend on its length; where it goes on from the
    file before, that file's last pings are looked at together with its first.

    Args:
        source: The open file.
        origin: What it is called.
        vehicle_id: This vehicle.
        config: Threshold, limit, size of the snippets.
    """

    def __init__(self, source: SurveySource, origin: Origin, vehicle_id: str, config: AtdStubConfig) -> None:
        self._source = source
        self._origin = origin
        self._vehicle_id = vehicle_id
        self._config = config
        self._overlap = config.join_overlap_pings
        self._settings = DetectorSettings(confidence_threshold=config.confidence_threshold)
        self._before: Seam | None = None
        self._first_wanted = 0
        self._held: list[SeamLook] = []
        self._known: list[SeamLook] = []
        self._found: list[_Found] = []

    def run(self, seam: Seam | None, now_utc_s: float) -> Finding:
        """Look for contacts.

        Args:
            seam: End of the file before, of the same sonar.
            now_utc_s: The time, for how long contacts at the file's end are held.

        Raises:
            SurveyFileError: The file can no longer be read.
        """
        pings = self._joined(self._source.pings(), seam)
        last: Strip | None = None
        for last in strips(pings, max(STRIP_PINGS, 2 * self._overlap), self._overlap):
            self._look_at(last)
            self._keep_best()
        assert last is not None, "an open survey has pings"
        return self._finding(last, now_utc_s)

    def _joined(self, pings: Iterator[Ping], seam: Seam | None) -> Iterator[Ping]:
        first = next(pings)
        self._before = seam.before(first) if seam is not None else None
        if seam is not None and self._before is not None:
            self._first_wanted = max(0, len(seam.pings) - self._overlap // 2)
            self._known = list(seam.looks)
            self._held = [look for look in seam.looks if look.held is not None]
            return chain(self._before.pings, (first,), pings)
        return chain((first,), pings)

    def _look_at(self, strip: Strip) -> None:
        info = self._source.info
        survey = Survey(info.path, info.sonar_id, info.line_name, strip.pings, info.warnings)
        half = self._overlap // 2
        # What lies before the middle of an overlap was seen better in the strip, or file, before.
        lower = strip.first_row + self._overlap - half if strip.first_row else self._first_wanted
        upper = math.inf if strip.is_last else strip.first_row + len(strip.pings) - half
        for found in detect(survey, self._settings):
            look = SeamLook.of(found, strip.first_row)
            if lower - _TOLERANCE_PINGS <= look.row < upper + _TOLERANCE_PINGS:
                self._take(survey, found, look)

    def _take(self, survey: Survey, found: Detection, look: SeamLook) -> None:
        is_new = True
        for known in [known for known in self._known if known.is_same(look)]:
            if known not in self._held:
                return
            # Seen whole now: this picture takes the place of the one that waited for it.
            self._held.remove(known)
            self._known.remove(known)
            is_new = False
        self._known.append(look)
        snippet = of_detection(survey, found, self._origin_of(look.row), self._vehicle_id, self._config)
        self._found.append(_Found(look, snippet, is_new))

    def _origin_of(self, row: int) -> Origin:
        before = self._before.origins if self._before is not None else ()
        return before[row] if row < len(before) else self._origin

    def _keep_best(self) -> None:
        """Hold no more than may be sent, and compare with no more than may be met again."""
        self._found.sort(key=_doubt)
        most = self._config.max_contacts
        if most:
            kept = [found for found in self._found if found.is_new][:most]
            self._found = [found for found in self._found if not found.is_new] + kept
            self._found.sort(key=_doubt)
        del self._known[:-_MOST_COMPARED]

    def _finding(self, last: Strip, now_utc_s: float) -> Finding:
        info, config = self._source.info, self._config
        end = last.first_row + len(last.pings)
        kept = last_pings(last.pings, self._overlap)
        held_from = max(end - self._overlap // 2, end - kept) if config.join_timeout_s > 0 and kept else math.inf
        held = [found for found in self._found if found.look.row >= held_from]
        # What waited at the end of the file before and was not seen again goes as it was.
        unseen = tuple(wire.decode(Snippet, look.held, "seam") for look in self._held if look.held is not None)
        seam = None
        if kept:
            start = end - kept
            waiting = {id(found.look) for found in held}
            others = (look for look in self._known if id(look) not in waiting and look.end_row > start)
            looks = (
                *(replace(look, held=None).moved(-start) for look in others),
                *(replace(found.look, held=wire.encode(found.snippet)).moved(-start) for found in held),
            )
            origins = tuple(self._origin_of(row) for row in range(start, end))
            pings = last.pings[len(last.pings) - kept :]
            seam = Seam(info.sonar_id, pings, origins, looks, now_utc_s + config.join_timeout_s)
        return Finding(
            snippets=(*unseen, *(found.snippet for found in self._found if found.look.row < held_from)),
            contacts=sum(found.is_new for found in self._found),
            seam=seam,
            joined=self._before is not None,
            warnings=info.warnings,
        )


def _doubt(found: _Found) -> float:
    return -(found.snippet.contact.atd_confidence or 0.0)
