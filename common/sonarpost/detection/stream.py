"""The streaming detector: contacts of recordings of any length and of consecutive files, each contact once.

Commands and the vehicle's service use it alike. A recording is searched in overlapping strips, so that memory does not
depend on its length. The end of a file is kept, and a file that continues it is searched together with it: a recorder
starts a new file after a number of pings, possibly in the middle of an object.

One rule holds at the boundaries of strips and of files. Of the overlap of two strips, the first strip decides about the
first half and the second strip about the second half: each shows more of the seabed around its half. Contacts in the
second half are held until the next strip is searched; at the end of a file they wait for the next file. An object that
ends beyond the first strip, such as a wreck, is taken from the second strip unless the first one has reported it.
Repeated detections of one object are associated by place (`sonarpost.detection.association`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Final, Generic, NamedTuple, Self, TypeVar

import numpy as np

from sonarpost.detection.association import DetectionPlace
from sonarpost.detection.detector import Detection, search
from sonarpost.detection.difficulty import Difficulty, combined
from sonarpost.detection.settings import DetectorSettings
from sonarpost.messages import Contact
from sonarpost.sonar.channel_sets import is_same_frequency
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.source import Strip, SurveySource, strips
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

STRIP_PINGS: Final = 1000
MAX_SONARS: Final = 8
_MIN_GAP_LIMIT_S: Final = 1.0
_GAP_LIMIT_INTERVALS: Final = 3.0
_MAX_GAP_M: Final = 30.0
_RANGE_TOLERANCE: Final = 0.01
_MAX_SAMPLE_BYTES: Final = 1 << 24
_CONTACT_FIELDS: Final = Contact.model_fields.keys() & Detection.__dataclass_fields__.keys()
"""Fields of a detection that its contact record has under the same name."""

T = TypeVar("T")
"""What the caller makes of a detection."""


@dataclass(frozen=True, slots=True)
class FileOrigin:
    """The file that a ping was recorded in.

    Attributes:
        content: Hex SHA-256 of the file.
        source: Its name, printable.
        line_name: Survey line, printable.
    """

    content: str
    source: str
    line_name: str

    @classmethod
    def of(cls, source: SurveySource, content: str) -> Self:
        """Return the origin of an open file; undecodable bytes of its name are escaped.

        Args:
            source: The open file.
            content: Hex SHA-256 of the file.
        """
        names = (source.info.path.name, source.info.line_name)
        return cls(content, *(name.encode("utf-8", "backslashreplace").decode() for name in names))

    def contact_id(self, detection: Detection) -> str:
        """Return the identifier of a contact whose centre is in this file."""
        place = f"{detection.ping_number}-{detection.side.value}-{detection.sample}"
        return f"{self.line_name[:60]}-{self.content[:8]}-{place}"


def contact_record(detection: Detection, origin: FileOrigin, vehicle_id: str, sonar_id: str) -> Contact:
    """Return the contact record of a detection. A height is set only if the shadow was recorded to its end.

    Args:
        detection: The detection.
        origin: The file of its ping.
        vehicle_id: Vehicle of the record.
        sonar_id: Sonar, as the file names it.
    """
    d = detection
    fields = {name: getattr(d, name) for name in _CONTACT_FIELDS}
    if d.shadow_is_cut:
        fields["height_m"] = None
    return Contact(
        contact_id=origin.contact_id(d),
        vehicle_id=vehicle_id,
        sonar_id=sonar_id,
        line_name=origin.line_name,
        channel=d.side.value,
        lat_deg=d.position.lat_deg if d.position else None,
        lon_deg=d.position.lon_deg if d.position else None,
        atd_confidence=d.confidence,
        **fields,
    )


class PingOrigin(NamedTuple):
    """File of a ping and its row in that file."""

    file: FileOrigin
    row: int


Describe = Callable[[Survey, Detection, PingOrigin], T]
"""Makes what the caller needs of a contact, from pings around it, the detection in them, and the origin of its ping."""


@dataclass(frozen=True, slots=True)
class StreamContact(Generic[T]):
    """A contact of a stream.

    Attributes:
        origin: File and row of the ping of its centre.
        place: Its place; in a `StreamEnd`, row 0 is the first ping there.
        content: What the caller made of the detection.
    """

    origin: PingOrigin
    place: DetectionPlace
    content: T


@dataclass(frozen=True, slots=True)
class StreamEnd(Generic[T]):
    """The end of the recording of one sonar: what the next file may continue.

    Attributes:
        sonar_id: Sonar of the recording.
        pings: The last pings; from several files where these are short.
        origins: The origin of each.
        open_row: The first of these rows about which no strip has decided.
        reported: Places of the contacts given before; row 0 is the first of `pings`.
        held: Contacts from `open_row` on, which wait for the next file.
    """

    sonar_id: str
    pings: tuple[Ping, ...]
    origins: tuple[PingOrigin, ...]
    open_row: int
    reported: tuple[DetectionPlace, ...]
    held: tuple[StreamContact[T], ...]

    def without_held(self) -> StreamEnd[T]:
        """Return this end after its held contacts were given: they are not given again."""
        return replace(self, reported=(*self.reported, *(contact.place for contact in self.held)), held=())

    def continued_by(self, first: Ping, sounded: Ping) -> StreamEnd[T] | None:
        """Return the part of this end before `first`, the first ping of another file of the same sonar.

        A recorder may repeat the last pings at the beginning of the next file; the repeated ones are left out. The
        channels are compared at the pings nearest the boundary that have channels: masked pings have none.

        Args:
            first: The first ping.
            sounded: The first ping with channels; a later ping of the file if it is unknown.

        Returns:
            None if that file does not continue the recording: the gap exceeds three ping intervals (at least one
            second) or 30 m, or the channels differ.
        """
        count = next((n for n, ping in enumerate(self.pings) if ping.time_utc_s >= first.time_utc_s), len(self.pings))
        if count == 0:
            return None
        last = self.pings[count - 1]
        times = [ping.time_utc_s for ping in self.pings[:count]]
        interval_s = float(np.median(np.diff(times))) if count > 1 else 0.0
        if first.time_utc_s - last.time_utc_s > max(_MIN_GAP_LIMIT_S, _GAP_LIMIT_INTERVALS * interval_s):
            return None
        ours = next((ping for ping in reversed(self.pings[:count]) if ping.channels), None)
        if ours is not None and sounded.channels and not _same_channels(ours, sounded):
            return None
        if not _is_near(last, first):
            return None
        return replace(self, pings=self.pings[:count], origins=self.origins[:count])


def _same_channels(one: Ping, other: Ping) -> bool:
    """Return whether two pings can be rows of one image: the same sides, sampled alike."""
    for side in Side:
        ours, theirs = one.channel(side), other.channel(side)
        if (ours is None) != (theirs is None):
            return False
        if ours is not None and theirs is not None and not _same_sampling(ours, theirs):
            return False
    return True


def _same_sampling(one: ChannelPing, other: ChannelPing) -> bool:
    return (
        one.samples.dtype == other.samples.dtype
        and len(one.samples) == len(other.samples)
        and math.isclose(one.slant_range_m, other.slant_range_m, rel_tol=_RANGE_TOLERANCE)
        and is_same_frequency(one, other)
    )


def _is_near(one: Ping, other: Ping) -> bool:
    if one.grid_m is not None and other.grid_m is not None:
        return math.dist(one.grid_m, other.grid_m) <= _MAX_GAP_M
    if one.lat_deg is None or one.lon_deg is None or other.lat_deg is None or other.lon_deg is None:
        return True
    offset_m = offset_between_m(Position(one.lat_deg, one.lon_deg), Position(other.lat_deg, other.lon_deg))
    return math.hypot(*offset_m) <= _MAX_GAP_M


@dataclass(frozen=True, slots=True)
class StripDifficulty:
    """Difficulty of the seabed of one side of a strip.

    Attributes:
        first_row: First ping of the strip in its file; 0 if the strip begins in the file before.
        end_row: One past its last ping.
        side: Side of the vehicle.
        difficulty: None if too little of the seabed is known.
    """

    first_row: int
    end_row: int
    side: Side
    difficulty: Difficulty | None


@dataclass(frozen=True, slots=True)
class FileResult(Generic[T]):
    """The contacts of one file.

    Attributes:
        contacts: Contacts decided with this file, most confident first; at most `max_contacts` with `held`. Their
            centres may lie in the file before.
        held: Contacts that wait for the next file, most confident first.
        released: Contacts held at the end of an earlier recording, which this file does not continue.
        joined: Whether the file continued an earlier one.
        replaced: Contacts held at the end of that one and detected again, now whole.
        dropped: Contacts held there and not detected in the joined pings.
        weaker: Number of contacts in this file at the confidences of `LISTED_CONFIDENCES` below the threshold;
            approximate at the boundaries of strips and files.
        difficulties: Difficulty of the seabed of each strip. Strips overlap, and the first one of a file that continues
            another begins with pings of that file.
    """

    contacts: tuple[StreamContact[T], ...]
    held: tuple[StreamContact[T], ...]
    released: tuple[StreamContact[T], ...]
    joined: bool
    replaced: tuple[StreamContact[T], ...]
    dropped: tuple[StreamContact[T], ...]
    weaker: Mapping[float, int]
    difficulties: tuple[StripDifficulty, ...] = ()

    @property
    def difficulty(self) -> Difficulty | None:
        """The mean of the strips and sides, weighted by area; None if too little seabed is known."""
        return combined(strip.difficulty for strip in self.difficulties)


class StreamDetector(Generic[T]):
    """Detects file by file, in the order of recording. Files of up to eight sonars may alternate.

    Args:
        describe: Called for each contact, while the pings around it are in memory.
        settings: None for the defaults. The maximum number of contacts applies to each file, held ones included.
        ends: Ends of earlier recordings by sonar, as `ends` of another detector returned them.
    """

    def __init__(
        self,
        describe: Describe[T],
        settings: DetectorSettings | None = None,
        ends: Mapping[str, StreamEnd[T]] | None = None,
    ) -> None:
        self._describe = describe
        self._settings = settings if settings is not None else DetectorSettings()
        self._ends: dict[str, StreamEnd[T]] = dict(ends or {})

    @property
    def ends(self) -> Mapping[str, StreamEnd[T]]:
        """The state between two files: the end of the latest recording of each sonar, the latest file last."""
        return dict(self._ends)

    def add_file(self, source: SurveySource, origin: FileOrigin) -> FileResult[T]:
        """Process the next file.

        Raises:
            SurveyFileError: The file has changed or cannot be read. The state is unchanged.
        """
        pings = source.pings()
        # Pings without channels hold no samples.
        begin: list[Ping] = []
        for ping in islice(pings, STRIP_PINGS):
            begin.append(ping)
            if ping.channels:
                break
        end = self._ends.get(source.info.sonar_id)
        previous = end.continued_by(begin[0], begin[-1]) if end is not None else None
        search_of_file = _FileSearch(source, origin, previous, self._describe, self._settings)
        new_end = search_of_file.run(chain(begin, pings))
        released = () if end is None or previous is not None else end.held
        self._ends.pop(new_end.sonar_id, None)
        self._ends[new_end.sonar_id] = new_end
        while len(self._ends) > MAX_SONARS:
            released += self._ends.pop(next(iter(self._ends))).held
        return replace(search_of_file.result, released=released)

    def release(self, sonar_id: str) -> tuple[StreamContact[T], ...]:
        """Give the contacts that are held for the continuation of a sonar's recording."""
        end = self._ends.get(sonar_id)
        if end is None:
            return ()
        self._ends[sonar_id] = end.without_held()
        return end.held

    def finish(self) -> tuple[StreamContact[T], ...]:
        """Give all contacts that are held."""
        return tuple(contact for sonar_id in tuple(self._ends) for contact in self.release(sonar_id))


class _FileSearch(Generic[T]):
    """The search of one file; `run` is called once and sets `result`. Row 0 is the first ping of `previous`."""

    def __init__(
        self,
        source: SurveySource,
        origin: FileOrigin,
        previous: StreamEnd[T] | None,
        describe: Describe[T],
        settings: DetectorSettings,
    ) -> None:
        self._source = source
        self._origin = origin
        self._previous = previous
        self._describe = describe
        self._settings = settings
        # The limit is applied to the file.
        self._strip_settings = settings.model_copy(update={"max_contacts": None})
        self._overlap = settings.join_overlap_pings
        self._first_new_row = len(previous.pings) if previous is not None else 0
        self._open_row = previous.open_row if previous is not None else 0
        self._seen_rows = self._first_new_row
        self._reported = list(previous.reported) if previous is not None else []
        self._held = [contact.place for contact in previous.held] if previous is not None else []
        self._repeated: set[int] = set()
        """Indices of the contacts held by `previous` that were detected again."""
        self._decided: list[tuple[float, StreamContact[T]]] = []
        """Confidence and contact."""
        self._waiting: list[tuple[float, StreamContact[T]]] = []
        self._weaker: Counter[float] = Counter()
        self._difficulties: list[StripDifficulty] = []
        self.result: FileResult[T]

    def run(self, pings: Iterable[Ping]) -> StreamEnd[T]:
        """Search the file; return its end."""
        joined = chain(self._previous.pings, pings) if self._previous is not None else iter(pings)
        last: Strip | None = None
        for last in strips(joined, max(STRIP_PINGS, 2 * self._overlap), self._overlap):
            self._search_strip(last)
        assert last is not None, "an open survey has pings"
        return self._finish(last)

    def _search_strip(self, strip: Strip) -> None:
        info, lower = self._source.info, self._open_row
        survey = Survey(info.path, info.sonar_id, info.line_name, strip.pings, info.warnings)
        end = strip.first_row + len(strip.pings)
        stored = stored_ping_count(strip.pings, self._overlap) if strip.is_last else self._overlap
        upper = max(lower, end - min(self._overlap // 2, stored))
        found = search(survey, self._strip_settings, self._source.options)
        rows = (max(0, strip.first_row - self._first_new_row), end - self._first_new_row)
        self._difficulties += [StripDifficulty(*rows, side, value) for side, value in found.difficulties.items()]
        for confidence, weaker_rows in found.weaker.items():
            in_strip = (strip.first_row + row for row in weaker_rows)
            first, behind = max(lower, self._first_new_row), math.inf if strip.is_last else upper
            self._weaker[confidence] += sum(first <= row < behind for row in in_strip)
        known, held = tuple(self._reported), self._held
        self._held = []
        for detection in found.detections:
            place = DetectionPlace.of_detection(detection, self._settings, strip.first_row)
            earlier = [n for n, other in enumerate(held) if place.is_same_object(other, self._settings)]
            if any(place.is_same_object(other, self._settings) for other in known):
                continue
            if place.row < lower and not earlier and place.end_row <= self._seen_rows:
                continue  # the strip before has shown it whole and decided about it
            if strip.first_row == 0:
                self._repeated.update(earlier)
            if place.row < upper:
                self._reported.append(place)
                self._decided.append(self._described(survey, detection, place))
            else:
                self._held.append(place)
                if strip.is_last:
                    self._waiting.append(self._described(survey, detection, place))
        self._open_row, self._seen_rows = upper, end
        self._decided.sort(key=lambda found: -found[0])
        del self._decided[self._settings.max_contacts or len(self._decided) :]
        start = end - self._overlap
        self._reported = [place for place in self._reported if self._last_row(place) >= start]

    def _described(self, survey: Survey, detection: Detection, place: DetectionPlace) -> tuple[float, StreamContact[T]]:
        origin = self._origin_of(place.row)
        content = self._describe(survey, detection, origin)
        return detection.confidence, StreamContact(origin, place, content)

    def _origin_of(self, row: int) -> PingOrigin:
        if self._previous is not None and row < self._first_new_row:
            return self._previous.origins[row]
        return PingOrigin(self._origin, row - self._first_new_row)

    def _last_row(self, place: DetectionPlace) -> int:
        """Return the last row in which a detection may be the same object."""
        return max(place.end_row, place.row + math.ceil(self._settings.separation_along_m / place.along_m))

    def _finish(self, last: Strip) -> StreamEnd[T]:
        both = sorted((*self._decided, *self._waiting), key=lambda found: -found[0])
        waiting = {id(contact) for _, contact in self._waiting}
        kept = [contact for _, contact in both[: self._settings.max_contacts]]
        held = tuple(contact for contact in kept if id(contact) in waiting)
        before = self._previous.held if self._previous is not None else ()
        self.result = FileResult(
            contacts=tuple(contact for contact in kept if id(contact) not in waiting),
            held=held,
            released=(),
            joined=self._previous is not None,
            replaced=tuple(contact for n, contact in enumerate(before) if n in self._repeated),
            dropped=tuple(contact for n, contact in enumerate(before) if n not in self._repeated),
            weaker=dict(self._weaker),
            difficulties=tuple(self._difficulties),
        )
        end = last.first_row + len(last.pings)
        stored = stored_ping_count(last.pings, self._overlap)
        start = end - stored
        return StreamEnd(
            sonar_id=self._source.info.sonar_id,
            pings=last.pings[len(last.pings) - stored :],
            origins=tuple(self._origin_of(row) for row in range(start, end)),
            open_row=self._open_row - start,
            reported=tuple(place.shifted(-start) for place in self._reported),
            held=tuple(replace(contact, place=contact.place.shifted(-start)) for contact in held),
        )


def stored_ping_count(pings: Sequence[Ping], max_pings: int) -> int:
    """Return how many of the last pings the end of a recording keeps: `max_pings`, at most 16 MiB of samples."""
    size = count = 0
    for ping in reversed(pings):
        size += sum(channel.samples.nbytes for channel in ping.channels)
        if count == max_pings or size > _MAX_SAMPLE_BYTES:
            break
        count += 1
    return count
