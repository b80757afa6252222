"""The survey as every reader delivers it: pings of one sonar, port and starboard, with navigation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

Samples = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.uint32]
FloatImage = npt.NDArray[np.float32]

MAX_SLANT_RANGE_M: Final = 10_000.0
"""No side-scan sonar reaches farther; a larger value in a file is damage."""


class Side(StrEnum):
    """Which side of the vehicle a channel looks to."""

    PORT = "port"
    STARBOARD = "starboard"


@dataclass(frozen=True, slots=True)
class ChannelPing:
    """One channel of one ping.

    Attributes:
        side: Port or starboard.
        samples: Echo strength, shape (n,), the file's own integer dtype; **index 0 is nearest the vehicle** on
            both sides, whatever order the file uses.
        slant_range_m: Slant range of the last sample's far edge, in metres.
        frequency_hz: Sonar frequency where the file gives it.
        scale: Echo strength is `samples` times this: a recorder's gain or weight that changes from ping to ping.
    """

    side: Side
    samples: Samples
    slant_range_m: float
    frequency_hz: float | None = None
    scale: float = 1.0

    @property
    def sample_spacing_m(self) -> float:
        """Slant range covered by one sample, in metres."""
        return self.slant_range_m / len(self.samples)

    def echo(self) -> FloatImage:
        """Return echo strength, shape (n,), float32: the samples with the recorder's weight applied."""
        return self.samples.astype(np.float32) * np.float32(self.scale)


@dataclass(frozen=True, slots=True)
class Ping:
    """One ping: its navigation and its channels. A value the file does not give is None, never a guess."""

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

    def channel(self, side: Side) -> ChannelPing | None:
        """Return the channel that pictures of `side` are made of, or None: the first of those that look there.

        A sonar of two frequencies has two channels a side, each with its own samples and range. Whatever looks at a
        side asks here, or `Survey.channels`, and never goes through all of a ping's channels.
        """
        return next((c for c in self.channels if c.side is side), None)

    def reach_m(self) -> float | None:
        """Return the slant range that pictures of this ping reach to, the farther side's; None without a channel."""
        return max((c.slant_range_m for side in Side if (c := self.channel(side)) is not None), default=None)


@dataclass(frozen=True, slots=True)
class Survey:
    """A recording held in memory (a file of about 1000 pings).

    Attributes:
        path: Where it was read from.
        sonar_id: Name of the sonar as the file gives it, or "unknown".
        line_name: Survey line, normally the file's stem.
        pings: In the order of recording.
        warnings: What the reader met and could explain (a ping without a fix, a skipped packet type), one line each.
    """

    path: Path
    sonar_id: str
    line_name: str
    pings: tuple[Ping, ...]
    warnings: tuple[str, ...] = field(default_factory=tuple)

    def sides(self) -> tuple[Side, ...]:
        """Return the sides that at least one ping has, port first."""
        present = {c.side for p in self.pings for c in p.channels}
        return tuple(s for s in Side if s in present)

    def channels(self, side: Side) -> Iterator[ChannelPing]:
        """Yield the channel that pictures of `side` are made of, of each ping that has one."""
        for ping in self.pings:
            channel = ping.channel(side)
            if channel is not None:
                yield channel

    def sample_count(self, side: Side) -> int:
        """Return how many samples the longest ping has in pictures of `side`; 0 where none has any."""
        return max((c.samples.shape[0] for c in self.channels(side)), default=0)

    def reach_m(self, side: Side) -> float:
        """Return the greatest slant range, in metres, of pictures of `side`; 0.0 where no ping has it."""
        return max((c.slant_range_m for c in self.channels(side)), default=0.0)

    def waterfall(self, side: Side) -> FloatImage:
        """Return one side as an image, shape (pings, samples), float32 in the file's units.

        A recorder's weight is applied. Row i is `pings[i]`; column 0 is nearest the vehicle. A ping without that
        side, and samples beyond a shorter ping, are NaN. Of several channels of a side the first is shown.
        """
        image = np.full((len(self.pings), self.sample_count(side)), np.nan, dtype=np.float32)
        for row, ping in enumerate(self.pings):
            channel = ping.channel(side)
            if channel is not None:
                image[row, : channel.samples.shape[0]] = channel.echo()
        return image

    def __iter__(self) -> Iterator[Ping]:
        return iter(self.pings)
