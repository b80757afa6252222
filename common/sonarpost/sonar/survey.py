"""Data model of a survey: pings of one sonar, port and starboard, with navigation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

Samples = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.uint32] | npt.NDArray[np.float32]
FloatImage = npt.NDArray[np.float32]

MAX_SLANT_RANGE_M: Final = 10_000.0
"""Longer than the range of any side-scan sonar; a greater value in a file means damage."""


class Side(StrEnum):
    """Side of the vehicle that a channel insonifies."""

    PORT = "port"
    STARBOARD = "starboard"


@dataclass(frozen=True, slots=True)
class ChannelPing:
    """One channel of one ping.

    Attributes:
        side: Port or starboard.
        samples: Stored values, shape (n,), unsigned integers of 8 to 32 bits or float32, finite and from 0 on; **index
            0 is nearest the vehicle** on both sides, in any file order.
        slant_range_m: Slant range of the far edge of the last sample.
        frequency_hz: Sonar frequency; None if unknown.
        scale: Factor from `samples` to echo strength: the recorder's gain or weight of this ping.
        index: Number of the channel in the file, to tell channels of the same side and frequency apart.
    """

    side: Side
    samples: Samples
    slant_range_m: float
    frequency_hz: float | None = None
    scale: float = 1.0
    index: int = 0

    @property
    def sample_spacing_m(self) -> float:
        """Slant range of one sample, in metres."""
        return self.slant_range_m / len(self.samples)

    def echo(self) -> FloatImage:
        """Return the echo strength, shape (n,), float32: the samples with `scale` applied."""
        return self.samples.astype(np.float32) * np.float32(self.scale)


@dataclass(frozen=True, slots=True)
class Ping:
    """One ping: navigation and channels. A value that the file does not contain is None.

    Attributes:
        number: Number in the file.
        time_utc_s: Time of transmission, seconds since 1970-01-01 UTC.
        channels: Channels of both sides. A `SurveySource` yields one channel set only: at most one channel a side.
        lat_deg: Latitude of the sonar, WGS 84, north positive.
        lon_deg: Longitude of the sonar, east positive.
        heading_deg: Heading of the sonar, clockwise from true north. A reader stores the sensor's; a `SurveySource`
            replaces it by the one that the options select.
        altitude_m: Altitude above the seabed.
        depth_m: Depth below the surface.
        speed_mps: Speed, forward positive.
        pitch_deg: Pitch as recorded.
        roll_deg: Roll as recorded.
        grid_m: Easting and northing of a file with projected coordinates, in metres; known without a projection.
        gyro_deg: Heading of the ship or vehicle that carries or tows the sonar, from true north.
        course_deg: Course over ground, from true north.
        layback_m: Horizontal distance along the track by which the sonar is behind the recorded position, to apply.
        heading_sigma_deg: Standard deviation of `heading_deg`, if it is not the sensor's.
        position_note: Why the position may be wrong by more than its standard deviation.
    """

    number: int
    time_utc_s: float
    channels: tuple[ChannelPing, ...]
    lat_deg: float | None = None
    lon_deg: float | None = None
    heading_deg: float | None = None
    altitude_m: float | None = None
    depth_m: float | None = None
    speed_mps: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None
    grid_m: tuple[float, float] | None = None
    gyro_deg: float | None = None
    course_deg: float | None = None
    layback_m: float | None = None
    heading_sigma_deg: float | None = None
    position_note: str | None = None

    def channel(self, side: Side) -> ChannelPing | None:
        """Return the first channel of `side`, or None."""
        return next((c for c in self.channels if c.side is side), None)

    def max_slant_range_m(self) -> float | None:
        """Return the greater slant range of both sides; None without a channel."""
        return max((c.slant_range_m for side in Side if (c := self.channel(side)) is not None), default=None)


@dataclass(frozen=True, slots=True)
class Survey:
    """A recording in memory (typically about 1000 pings).

    Attributes:
        path: The file.
        sonar_id: Name of the sonar in the file, or "unknown".
        line_name: Survey line, normally the stem of the file name.
        pings: In the order of recording.
        warnings: Irregularities of the file (pings without a fix, skipped packet types), one line each.
    """

    path: Path
    sonar_id: str
    line_name: str
    pings: tuple[Ping, ...]
    warnings: tuple[str, ...] = field(default_factory=tuple)

    def sides(self) -> tuple[Side, ...]:
        """Return the sides of all pings together, port first."""
        present = {c.side for p in self.pings for c in p.channels}
        return tuple(s for s in Side if s in present)

    def channels(self, side: Side) -> Iterator[ChannelPing]:
        """Yield the channel of `side` of each ping that has one."""
        for ping in self.pings:
            channel = ping.channel(side)
            if channel is not None:
                yield channel

    def sample_count(self, side: Side) -> int:
        """Return the maximum number of samples of a ping on `side`; 0 without samples."""
        return max((c.samples.shape[0] for c in self.channels(side)), default=0)

    def max_slant_range_m(self, side: Side) -> float:
        """Return the maximum slant range of `side` in metres; 0.0 if no ping has that side."""
        return max((c.slant_range_m for c in self.channels(side)), default=0.0)

    def waterfall(self, side: Side) -> FloatImage:
        """Return the echo strength of one side, shape (pings, samples), float32 in the units of the file.

        Row i is `pings[i]`; column 0 is nearest the vehicle. A ping without that side, and samples beyond the end of
        a shorter ping, are NaN.
        """
        image = np.full((len(self.pings), self.sample_count(side)), np.nan, dtype=np.float32)
        for row, ping in enumerate(self.pings):
            channel = ping.channel(side)
            if channel is not None:
                image[row, : channel.samples.shape[0]] = channel.echo()
        return image

    def __iter__(self) -> Iterator[Ping]:
        return iter(self.pings)
