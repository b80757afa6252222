"""The ends of the latest recordings in the store: their last pings, and the contacts that wait for the next file.

A recorder may begin a new file every thousand pings and cut an object in two. The end of each file is kept, so that the
continuation file is searched together with it (`sonarpost.detection.stream`), also after a restart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import msgpack
import numpy as np

from sonarpost import wire
from sonarpost.delivery.store import Store
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.detection.association import DetectionPlace
from sonarpost.detection.stream import FileOrigin, PingOrigin, StreamContact, StreamEnd
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub.survey_detection import SurveyEnd, snippets_of
from sonarpost.sonar.survey import ChannelPing, Ping, Side

FORMAT: Final = 2
_STATE_PREFIX: Final = "seam:"


@dataclass(frozen=True, slots=True)
class StoredEnd:
    """The end of a recording as stored.

    Attributes:
        end: The end of the recording.
        hold_until_utc_s: When its held contacts are released without a continuation file.
    """

    end: SurveyEnd
    hold_until_utc_s: float


class FileEndStore:
    """The end of the latest recording of each sonar, in the store and in memory.

    `put` and `release_expired` write into a unit of work; call `committed` after its commit. For one thread.

    Args:
        store: The service's store.
    """

    def __init__(self, store: Store) -> None:
        self._ends = store.read_states(_STATE_PREFIX, _of_sonar)
        self._uncommitted = dict(self._ends)
        self.held_count = self._count_held()

    def by_sonar(self) -> Mapping[str, SurveyEnd]:
        """Return the ends by sonar."""
        return {sonar_id: stored.end for sonar_id, stored in self._ends.items()}

    def put(self, effects: UnitOfWork, ends: Mapping[str, SurveyEnd], hold_until_utc_s: float) -> None:
        """Store the ends after a file.

        Args:
            effects: Receives the writes.
            ends: All ends; those that have changed replace the stored ones.
            hold_until_utc_s: When the held contacts of the changed ones are released without a continuation file.
        """
        self._uncommitted = {}
        for sonar_id, end in ends.items():
            known = self._ends.get(sonar_id)
            if known is None or known.end is not end:
                known = StoredEnd(end, hold_until_utc_s)
                effects.put_state(_STATE_PREFIX + sonar_id, pack(known))
            self._uncommitted[sonar_id] = known
        for sonar_id in self._ends.keys() - ends.keys():
            effects.delete_state(_STATE_PREFIX + sonar_id)

    def release_expired(self, effects: UnitOfWork, now_utc_s: float, timeout_s: float) -> tuple[Snippet, ...]:
        """Return held contacts whose waiting time is over. A clock that is set back does not extend it."""
        self._uncommitted = dict(self._ends)
        expired: list[Snippet] = []
        for sonar_id, stored in self._ends.items():
            if stored.end.held and not now_utc_s < stored.hold_until_utc_s <= now_utc_s + timeout_s:
                expired += snippets_of(stored.end.held)
                released = replace(stored, end=stored.end.without_held())
                self._uncommitted[sonar_id] = released
                effects.put_state(_STATE_PREFIX + sonar_id, pack(released))
        return tuple(expired)

    @property
    def held_until_utc_s(self) -> float:
        """When the last held contact is released without a continuation file; 0 if none is held."""
        return max((stored.hold_until_utc_s for stored in self._ends.values() if stored.end.held), default=0.0)

    def committed(self) -> None:
        """Apply the last change in memory."""
        self._ends = self._uncommitted
        self.held_count = self._count_held()

    def _count_held(self) -> int:
        return sum(len(stored.end.held) for stored in self._ends.values())


def _of_sonar(sonar_id: str, packed: bytes) -> StoredEnd:
    """Return a stored end with the name of its sonar."""
    stored = unpack(packed)
    return replace(stored, end=replace(stored.end, sonar_id=sonar_id))


def pack(stored: StoredEnd) -> bytes:
    """Return the end of a recording as msgpack, for the store."""
    end = stored.end
    files = list(dict.fromkeys(origin.file for origin in end.origins))
    packed: bytes = msgpack.packb(
        {
            "format": FORMAT,
            "sonar_id": end.sonar_id,
            "until_utc_s": stored.hold_until_utc_s,
            "files": [[file.content, file.source, file.line_name] for file in files],
            "origins": [[files.index(origin.file), origin.row] for origin in end.origins],
            "pings": [_packed_ping(ping) for ping in end.pings],
            "open_row": end.open_row,
            "reported": [_packed_place(place) for place in end.reported],
            "held": [[_packed_place(contact.place), wire.encode(contact.content)] for contact in end.held],
        }
    )
    return packed


def unpack(packed: bytes) -> StoredEnd:
    """Return what `pack` was called with.

    Raises:
        ValueError: It has another format, or is damaged.
        PayloadError: A held contact is damaged.
    """
    try:
        fields = msgpack.unpackb(packed)
        if fields["format"] != FORMAT:
            raise ValueError(f"file end: format: got {fields['format']}, expected {FORMAT}")
        return StoredEnd(_end(fields), float(fields["until_utc_s"]))
    except (KeyError, IndexError, TypeError, msgpack.UnpackException) as error:
        raise ValueError(f"file end: content: got {type(error).__name__}: {error}, expected a file end") from error


def _end(fields: Mapping[str, Any]) -> SurveyEnd:
    files = [FileOrigin(*each) for each in fields["files"]]
    origins = tuple(PingOrigin(files[number], row) for number, row in fields["origins"])
    held = ((_place(place), wire.decode(Snippet, payload, "file end")) for place, payload in fields["held"])
    return StreamEnd(
        sonar_id=fields["sonar_id"],
        pings=tuple(_unpacked_ping(each) for each in fields["pings"]),
        origins=origins,
        open_row=fields["open_row"],
        reported=tuple(map(_place, fields["reported"])),
        held=tuple(StreamContact(origins[place.row], place, content) for place, content in held),
    )


def _packed_place(place: DetectionPlace) -> list[object]:
    rows = [place.row, place.first_row, place.end_row]
    return [place.side.value, *rows, place.slant_range_m, place.near_m, place.far_m, place.along_m]


def _place(packed: list[Any]) -> DetectionPlace:
    side, *rest = packed
    return DetectionPlace(Side(side), *rest)


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
_POSITION = ("layback_m", "heading_sigma_deg", "position_note")


def _packed_ping(ping: Ping) -> list[object]:
    channels = [
        [c.side.value, c.samples.dtype.str, c.samples.tobytes(), c.slant_range_m, c.frequency_hz, c.scale]
        for c in ping.channels
    ]
    values = [getattr(ping, name) for name in _NAVIGATION]
    position = [getattr(ping, name) for name in _POSITION]
    if all(value is None for value in position):
        position = []
    return [ping.number, ping.time_utc_s, channels, *values, ping.grid_m, *position]


def _unpacked_ping(packed: list[Any]) -> Ping:
    number, time_utc_s, channels, *navigation = packed
    unpacked = tuple(
        ChannelPing(Side(side), np.frombuffer(data, dtype=np.dtype(kind)), slant_range_m, frequency_hz, scale)
        for side, kind, data, slant_range_m, frequency_hz, scale in channels
    )
    count = len(_NAVIGATION)
    grid_m, *position = navigation[count:]
    values = dict(zip(_NAVIGATION, navigation[:count], strict=True))
    values |= dict(zip(_POSITION, position, strict=False))  # left out where all are unknown
    return Ping(number, time_utc_s, unpacked, **values, grid_m=None if grid_m is None else (grid_m[0], grid_m[1]))
