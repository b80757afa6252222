"""The boundary between two consecutive survey files of one recording.

A recorder may begin a new file every thousand pings and cut an object in two. The last pings of a file and the
contacts detected there are kept in the store. The continuation file is searched together with these pings, and
detections of the same object from both searches become one contact.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import msgpack
import numpy as np

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.detection.association import DetectionPosition
from sonarpost.logs import kv
from sonarpost.messages import Snippet
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.survey import ChannelPing, Ping, Side

log = logging.getLogger(__name__)

FORMAT: Final = 1
MAX_SONARS: Final = 8
_STATE_PREFIX: Final = "seam:"
_SAME_OBJECT_M: Final = (3.0, math.nextafter(3.0, math.inf))
"""Detections less than 3 m apart are one object, as within a file; across-track also at exactly 3 m."""
_MIN_GAP_LIMIT_S: Final = 1.0
_GAP_LIMIT_INTERVALS: Final = 3.0
_MAX_GAP_M: Final = 30.0
_RANGE_TOLERANCE: Final = 0.01
_MAX_SAMPLE_BYTES: Final = 1 << 24


@dataclass(frozen=True, slots=True)
class Origin:
    """The file that a ping was recorded in.

    Attributes:
        content: Hex SHA-256 of the file.
        source: Its name, printable.
        line_name: Survey line.
    """

    content: str
    source: str
    line_name: str


@dataclass(frozen=True, slots=True)
class BoundaryDetection(DetectionPosition):
    """A detection near the end of a file.

    Attributes:
        held: Encoded snippet that waits for the continuation file; None where it was released or was a duplicate.
    """

    held: bytes | None = None

    @property
    def held_contact_id(self) -> str:
        """Identifier of the held contact; empty for none."""
        return "" if self.held is None else wire.decode(Snippet, self.held, "file end").contact.contact_id

    def is_same_object(self, other: DetectionPosition) -> bool:
        """Return whether both detections are of one object."""
        return self.is_near(other, *_SAME_OBJECT_M, overlapping=True)


@dataclass(frozen=True, slots=True)
class FileEnd:
    """The last pings of a recording and the detections in them.

    Attributes:
        sonar_id: Sonar of the recording.
        pings: The last pings; from several files where these are short.
        origins: The file of each ping.
        detections: Contacts detected in these pings; row 0 is the first ping.
        hold_until_utc_s: When held snippets are released without a continuation file.
    """

    sonar_id: str
    pings: tuple[Ping, ...]
    origins: tuple[Origin, ...]
    detections: tuple[BoundaryDetection, ...]
    hold_until_utc_s: float

    @property
    def held(self) -> tuple[bytes, ...]:
        """Encoded snippets that wait for the continuation file."""
        return tuple(detection.held for detection in self.detections if detection.held is not None)

    def held_snippets(self) -> tuple[Snippet, ...]:
        """Return the snippets that wait for the continuation file."""
        return tuple(wire.decode(Snippet, payload, "file end") for payload in self.held)

    def without_held(self) -> FileEnd:
        """Return the file end with no snippet held."""
        return replace(self, detections=tuple(replace(detection, held=None) for detection in self.detections))

    def continued_by(self, first: Ping) -> FileEnd | None:
        """Return the part of this file end before `first`, the first ping of another file.

        A recorder may repeat the last pings at the beginning of the next file; the repeated ones are left out.

        Returns:
            None if that file does not continue the recording.
        """
        count = next((n for n, ping in enumerate(self.pings) if ping.time_utc_s >= first.time_utc_s), len(self.pings))
        if count == 0:
            return None
        last = self.pings[count - 1]
        times = [ping.time_utc_s for ping in self.pings[:count]]
        interval_s = float(np.median(np.diff(times))) if count > 1 else 0.0
        if first.time_utc_s - last.time_utc_s > max(_MIN_GAP_LIMIT_S, _GAP_LIMIT_INTERVALS * interval_s):
            return None
        if not (_same_channels(last, first) and _is_near(last, first)):
            return None
        return replace(self, pings=self.pings[:count], origins=self.origins[:count])


def _same_channels(one: Ping, other: Ping) -> bool:
    """Return whether two pings can be rows of one image: the same channels, sampled alike."""
    for side in Side:
        ours = [channel for channel in one.channels if channel.side is side]
        theirs = [channel for channel in other.channels if channel.side is side]
        # A dual-frequency sonar has two channels a side, each with its own range; a file keeps their order.
        if len(ours) != len(theirs) or not all(map(_same_sampling, ours, theirs)):
            return False
    return True


def _same_sampling(one: ChannelPing, other: ChannelPing) -> bool:
    return (
        one.samples.dtype == other.samples.dtype
        and len(one.samples) == len(other.samples)
        and math.isclose(one.slant_range_m, other.slant_range_m, rel_tol=_RANGE_TOLERANCE)
    )


def _is_near(one: Ping, other: Ping) -> bool:
    if one.lat_deg is None or one.lon_deg is None or other.lat_deg is None or other.lon_deg is None:
        return True
    offset_m = offset_between_m(Position(one.lat_deg, one.lon_deg), Position(other.lat_deg, other.lon_deg))
    return math.hypot(*offset_m) <= _MAX_GAP_M


def stored_ping_count(pings: Sequence[Ping], max_pings: int) -> int:
    """Return how many of the last pings a file end holds: at most `max_pings`, and at most 16 MiB of samples."""
    size = count = 0
    for ping in reversed(pings):
        size += sum(channel.samples.nbytes for channel in ping.channels)
        if count == max_pings or size > _MAX_SAMPLE_BYTES:
            break
        count += 1
    return count


class FileEndStore:
    """The end of the latest file of each sonar, in the store and in memory.

    `put` and `release_expired` write into a unit of work; call `committed` after its commit. For one thread.

    Args:
        store: The service's store.
    """

    def __init__(self, store: Store) -> None:
        self._ends: dict[str, FileEnd] = {}
        for name, packed in store.states(_STATE_PREFIX).items():
            try:
                self._ends[_STATE_PREFIX + name] = unpack(packed)
            except ValueError as error:
                # It stays in the store for the version that wrote it.
                log.warning("Ignoring unreadable file end", extra=kv(reason=str(error)))
        self._uncommitted = dict(self._ends)
        self.held_count = self._count_held()

    def by_sonar(self) -> Mapping[str, FileEnd]:
        """Return the file ends by sonar."""
        return {end.sonar_id: end for end in self._ends.values()}

    def put(self, effects: UnitOfWork, end: FileEnd | None, *, joined: bool) -> tuple[Snippet, ...]:
        """Store a file end in place of the previous one of its sonar.

        Args:
            effects: Receives the writes.
            end: The new file end, None where none is kept.
            joined: Whether the file continued the previous file end, whose held snippets are then processed already.

        Returns:
            Snippets that were held at a file end without a continuation.
        """
        self._uncommitted = dict(self._ends)
        if end is None:
            return ()
        name = _STATE_PREFIX + end.sonar_id
        previous = self._uncommitted.pop(name, None)
        dropped = [] if previous is None or joined else [previous]
        self._uncommitted[name] = end
        effects.put_state(name, pack(end))
        while len(self._uncommitted) > MAX_SONARS:
            oldest = next(iter(self._uncommitted))
            dropped.append(self._uncommitted.pop(oldest))
            effects.delete_state(oldest)
        return tuple(snippet for each in dropped for snippet in each.held_snippets())

    def release_expired(self, effects: UnitOfWork, now_utc_s: float, timeout_s: float) -> tuple[Snippet, ...]:
        """Return held snippets whose waiting time is over. A clock that is set back does not extend it."""
        self._uncommitted = dict(self._ends)
        expired: list[Snippet] = []
        for name, end in self._ends.items():
            if end.held and not now_utc_s < end.hold_until_utc_s <= now_utc_s + timeout_s:
                expired += end.held_snippets()
                self._uncommitted[name] = end.without_held()
                effects.put_state(name, pack(self._uncommitted[name]))
        return tuple(expired)

    @property
    def held_until_utc_s(self) -> float:
        """When the last held contact is released without a continuation file; 0 if none is held."""
        return max((end.hold_until_utc_s for end in self._ends.values() if end.held), default=0.0)

    def committed(self) -> None:
        """Apply the last change in memory."""
        self._ends = self._uncommitted
        self.held_count = self._count_held()

    def _count_held(self) -> int:
        return sum(len(end.held) for end in self._ends.values())


def pack(end: FileEnd) -> bytes:
    """Return the file end as msgpack, for the store."""
    files = list(dict.fromkeys(end.origins))
    packed: bytes = msgpack.packb(
        {
            "format": FORMAT,
            "sonar_id": end.sonar_id,
            "until_utc_s": end.hold_until_utc_s,
            "files": [[o.content, o.source, o.line_name] for o in files],
            "file_of": [files.index(o) for o in end.origins],
            "pings": [_packed_ping(ping) for ping in end.pings],
            "looks": [
                [d.side.value, d.row, d.first_row, d.end_row, d.slant_range_m, d.along_m, d.held]
                for d in end.detections
            ],
        }
    )
    return packed


def unpack(packed: bytes) -> FileEnd:
    """Return the file end that `pack` was called with.

    Raises:
        ValueError: It has another format.
    """
    fields = msgpack.unpackb(packed)
    if fields["format"] != FORMAT:
        raise ValueError(f"file end: format: got {fields['format']}, expected {FORMAT}")
    files = [Origin(*each) for each in fields["files"]]
    return FileEnd(
        sonar_id=fields["sonar_id"],
        pings=tuple(_unpacked_ping(each) for each in fields["pings"]),
        origins=tuple(files[number] for number in fields["file_of"]),
        detections=tuple(BoundaryDetection(Side(side), *rest) for side, *rest in fields["looks"]),
        hold_until_utc_s=fields["until_utc_s"],
    )


_NAVIGATION = (
    "lat_deg",
    "lon_deg",
    "heading_deg",
    "altitude_m",
    "depth_m",
    "speed_mps",
    "pitch_deg",
    "roll_deg",
)


def _packed_ping(ping: Ping) -> list[object]:
    channels = [
        [c.side.value, c.samples.dtype.str, c.samples.tobytes(), c.slant_range_m, c.frequency_hz, c.scale]
        for c in ping.channels
    ]
    return [ping.number, ping.time_utc_s, channels, *(getattr(ping, name) for name in _NAVIGATION)]


def _unpacked_ping(packed: list[object]) -> Ping:
    number, time_utc_s, channels, *navigation = packed
    assert isinstance(number, int)
    assert isinstance(time_utc_s, float)
    assert isinstance(channels, list)
    unpacked = tuple(
        ChannelPing(Side(side), np.frombuffer(data, dtype=np.dtype(kind)), slant_range_m, frequency_hz, scale)
        for side, kind, data, slant_range_m, frequency_hz, scale in channels
    )
    values: dict[str, float | None] = {}
    for name, value in zip(_NAVIGATION, navigation, strict=True):
        assert value is None or isinstance(value, float)
        values[name] = value
    return Ping(number, time_utc_s, unpacked, **values)
