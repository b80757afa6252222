"""What bytes of a group of pictures are worth: their gains in dB, best first.

A picture's PSNR by bytes is replaced by its concave hull, so that spending bytes where the slope is steepest is optimal
(Shoham and Gersho, "Efficient bit allocation for an arbitrary set of quantizers", IEEE Trans. ASSP 36, 1988).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import StreamError
from sonarpost.link.frames.v1.payload_objects import MAX_STREAM_BYTES

Values = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]
_PEAK_SQUARED: Final = 255.0**2
_LEAST_ERROR: Final = 0.065  # 60 dB
_NO_PICTURE: Final = 3.0 * 55.0**2  # mean squared error against mid-grey of what cannot be shown at all


def quality_curve(stream_bytes: int, mean_square_error: Sequence[float] | Values | None = None) -> Values:
    """Return PSNR in dB by the number of bytes there are, shape (stream_bytes + 1,).

    Args:
        stream_bytes: Length of the stream.
        mean_square_error: Of the picture that the first n bytes give, shape (stream_bytes + 1,), infinite where there
            is none, as `emb` estimates it. Without it, 1.2 dB for every doubling: what is true of most codecs at these
            rates.

    Raises:
        StreamError: The shape is another, or the stream is longer than a stream may be.
    """
    if stream_bytes > MAX_STREAM_BYTES:
        raise StreamError("picture", "stream", f"{stream_bytes} bytes", f"at most {MAX_STREAM_BYTES}")
    if mean_square_error is None:
        return 13.0 + 1.2 * np.log2(1.0 + np.arange(stream_bytes + 1) / 4.0)
    error = np.asarray(mean_square_error, np.float64)
    if error.shape != (stream_bytes + 1,) or np.isnan(error).any() or (error < 0).any():
        raise StreamError("picture", "mean square error", error.shape, f"{stream_bytes + 1} values of 0 or more")
    error = np.minimum.accumulate(np.clip(error, _LEAST_ERROR, _NO_PICTURE))
    return 10.0 * np.log10(_PEAK_SQUARED / error)


def _hull(curve: Values, start: int) -> tuple[list[int], list[float]]:
    """Return the corners of the upper concave hull of `curve[start:]`: positions and values."""
    # Only where the curve rises can a corner be.
    rises = np.flatnonzero(np.diff(curve[start:]) > 0) + start + 1
    places, values = [start], [float(curve[start])]
    for place in rises.tolist():
        value = float(curve[place])
        while len(places) > 1 and (values[-1] - values[-2]) * (place - places[-1]) <= (value - values[-1]) * (
            places[-1] - places[-2]
        ):
            places.pop()
            values.pop()
        places.append(place)
        values.append(value)
    return places, values


@dataclass(frozen=True, eq=False)
class GroupDistortion:
    """The gains of a group, steepest first.

    Attributes:
        starts: Shape (pictures,): bytes of each that are sent elsewhere.
        owners: Shape (steps,): whose bytes each step is.
        step_bytes: Shape (steps,): how many.
        bytes_by_step: Shape (steps + 1,): bytes of the group after each step, 0 first.
        gain_by_step: Shape (steps + 1,): summed dB after each step, 0 first.
    """

    starts: Counts
    owners: Counts
    step_bytes: Counts
    bytes_by_step: Counts
    gain_by_step: Values

    @classmethod
    def of(cls, curves: Sequence[Values], starts: Sequence[int]) -> GroupDistortion:
        """Merge the hulls of pictures, each from its start on."""
        owners, sizes, gains = [], [], []
        for owner, (curve, start) in enumerate(zip(curves, starts, strict=True)):
            places, values = _hull(curve, min(start, len(curve) - 1))
            owners += [owner] * (len(places) - 1)
            sizes += [b - a for a, b in pairwise(places)]
            gains += [b - a for a, b in pairwise(values)]
        size, gain = np.array(sizes, np.int64), np.array(gains, np.float64)
        order = np.argsort(-gain / np.maximum(size, 1), kind="stable") if size.size else np.zeros(0, np.int64)
        return cls(
            np.array(starts, np.int64),
            np.array(owners, np.int64)[order],
            size[order],
            np.concatenate([[0], np.cumsum(size[order])]).astype(np.int64),
            np.concatenate([[0.0], np.cumsum(gain[order])]),
        )

    @property
    def total_bytes(self) -> int:
        """Bytes that are worth anything."""
        return int(self.bytes_by_step[-1])

    def gains(self, group_bytes: npt.NDArray[np.int64]) -> Values:
        """Return the summed dB of so many bytes, any shape."""
        return np.interp(group_bytes, self.bytes_by_step, self.gain_by_step)

    def stops(self, group_bytes: int) -> list[int]:
        """Return up to which byte of its stream each picture gets when the group has so many bytes."""
        step = int(np.searchsorted(self.bytes_by_step, group_bytes, side="right")) - 1
        more = np.bincount(self.owners[:step], self.step_bytes[:step], self.starts.size).astype(np.int64)
        if step < self.owners.size:
            more[self.owners[step]] += group_bytes - self.bytes_by_step[step]
        return [int(stop) for stop in self.starts + more]
