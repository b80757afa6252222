"""The seam between two survey files: the last pings of one, and what was found there, until the next one comes.

A recorder that begins a new file every thousand pings cuts objects in two. The last pings of a file stay in the store;
the file that goes on where they end is looked at together with them, and what both looks have seen is one contact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import msgpack
import numpy as np

from sonarpost.detection.association import AssociationRule, DetectionPosition
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.survey import ChannelPing, Ping, Side

FORMAT: Final = 1
_SAMENESS: Final = AssociationRule(along_m=3.0, across_m=math.nextafter(3.0, math.inf), overlapping=True)
"""Contacts nearer to each other than 3 m are one, as within a file; across-track at 3 m too."""
_LEAST_GAP_S: Final = 1.0
_GAP_INTERVALS: Final = 3.0
_MOST_GAP_M: Final = 30.0
_RANGE_AGREEMENT: Final = 0.01
_MOST_BYTES: Final = 1 << 24


@dataclass(frozen=True, slots=True)
class Origin:
    """The file a ping was in.

    Attributes:
        content: Hex sha256 of the file.
        source: Its name, as records and logs need it.
        line_name: Of the survey.
    """

    content: str
    source: str
    line_name: str


@dataclass(frozen=True, slots=True)
class SeamLook(DetectionPosition):
    """A contact as it was seen in one look, and what waits with it.

    Attributes:
        held: The snippet's payload where it waits for the next file, else None.
    """

    held: bytes | None = None

    def is_same(self, other: DetectionPosition) -> bool:
        """Tell whether both are looks at one object."""
        return _SAMENESS.holds(self, other, abs(self.slant_range_m - other.slant_range_m))


@dataclass(frozen=True, slots=True)
class Seam:
    """The end of a file.

    Attributes:
        sonar_id: Of the recording.
        pings: Its last ones, of several files where these are short.
        origins: The file of each ping.
        looks: Contacts found among them; row 0 is the first of the pings.
        until_utc_s: When those that are held go as they are.
    """

    sonar_id: str
    pings: tuple[Ping, ...]
    origins: tuple[Origin, ...]
    looks: tuple[SeamLook, ...]
    until_utc_s: float

    @property
    def held(self) -> tuple[bytes, ...]:
        """Payloads of the snippets that wait."""
        return tuple(look.held for look in self.looks if look.held is not None)

    def let_go(self) -> Seam:
        """Return the seam with nothing held."""
        return replace(self, looks=tuple(replace(look, held=None) for look in self.looks))

    def before(self, ping: Ping) -> Seam | None:
        """Return what of the seam comes before a file's first ping, None where that file does not go on here.

        A recorder may write the last pings once more at the beginning of the next file: these are taken from there.
        """
        count = next((n for n, mine in enumerate(self.pings) if mine.time_utc_s >= ping.time_utc_s), len(self.pings))
        if count == 0:
            return None
        last = self.pings[count - 1]
        times = [mine.time_utc_s for mine in self.pings[:count]]
        interval_s = float(np.median(np.diff(times))) if count > 1 else 0.0
        if ping.time_utc_s - last.time_utc_s > max(_LEAST_GAP_S, _GAP_INTERVALS * interval_s):
            return None
        if not (_same_shape(last, ping) and _near(last, ping)):
            return None
        return replace(self, pings=self.pings[:count], origins=self.origins[:count])


def _same_shape(one: Ping, other: Ping) -> bool:
    """Whether two pings can be rows of one picture: the same channels, each sampled as before."""
    for side in Side:
        mine = [channel for channel in one.channels if channel.side is side]
        theirs = [channel for channel in other.channels if channel.side is side]
        # A sonar of two frequencies has two channels a side, each with a range of its own: a file keeps their order.
        if len(mine) != len(theirs) or not all(map(_same_sampling, mine, theirs)):
            return False
    return True


def _same_sampling(one: ChannelPing, other: ChannelPing) -> bool:
    return (
        one.samples.dtype == other.samples.dtype
        and len(one.samples) == len(other.samples)
        and math.isclose(one.slant_range_m, other.slant_range_m, rel_tol=_RANGE_AGREEMENT)
    )


def _near(one: Ping, other: Ping) -> bool:
    if one.lat_deg is None or one.lon_deg is None or other.lat_deg is None or other.lon_deg is None:
        return True
    apart = offset_between_m(Position(one.lat_deg, one.lon_deg), Position(other.lat_deg, other.lon_deg))
    return math.hypot(*apart) <= _MOST_GAP_M


def last_pings(pings: Sequence[Ping], most: int) -> int:
    """Return how many of the last pings a seam keeps: at most `most`, and at most 16 MiB of samples."""
    size = count = 0
    for ping in reversed(pings):
        size += sum(channel.samples.nbytes for channel in ping.channels)
        if count == most or size > _MOST_BYTES:
            break
        count += 1
    return count


def pack(seam: Seam) -> bytes:
    """Return the seam as msgpack, for the store."""
    files = list(dict.fromkeys(seam.origins))
    packed: bytes = msgpack.packb(
        {
            "format": FORMAT,
            "sonar_id": seam.sonar_id,
            "until_utc_s": seam.until_utc_s,
            "files": [[o.content, o.source, o.line_name] for o in files],
            "file_of": [files.index(o) for o in seam.origins],
            "pings": [_packed_ping(ping) for ping in seam.pings],
            "looks": [
                [k.side.value, k.row, k.first_row, k.end_row, k.slant_range_m, k.along_m, k.held] for k in seam.looks
            ],
        }
    )
    return packed


def unpack(packed: bytes) -> Seam:
    """Return what `pack` was given.

    Raises:
        ValueError: It was packed by a version whose format is another.
    """
    fields = msgpack.unpackb(packed)
    if fields["format"] != FORMAT:
        raise ValueError(f"a seam of format {fields['format']}, expected {FORMAT}")
    files = [Origin(*each) for each in fields["files"]]
    return Seam(
        sonar_id=fields["sonar_id"],
        pings=tuple(_unpacked_ping(each) for each in fields["pings"]),
        origins=tuple(files[number] for number in fields["file_of"]),
        looks=tuple(SeamLook(Side(side), *rest) for side, *rest in fields["looks"]),
        until_utc_s=fields["until_utc_s"],
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
    held = tuple(
        ChannelPing(Side(side), np.frombuffer(data, dtype=np.dtype(kind)), slant_range_m, frequency_hz, scale)
        for side, kind, data, slant_range_m, frequency_hz, scale in channels
    )
    values: dict[str, float | None] = {}
    for name, value in zip(_NAVIGATION, navigation, strict=True):
        assert value is None or isinstance(value, float)
        values[name] = value
    return Ping(number, time_utc_s, held, **values)
