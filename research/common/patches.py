"""Training images cut from side-scan lines and stretched to 8 bits like snippets.

A codebook serves many sonars, so a line is used at several scales and tones. Each window is reduced by block means, as
if the line were sampled more coarsely. Windows are mirrored in turn (port and starboard shadows point in opposite
directions) and mapped to one of several tones (dark with one bright target, or bright all over).
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from research.codebook.builder import TrainingImage
from sonarpost.codec.interface import Image

SonarLine = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ToneMapping:
    """A tone curve: `255 * gain * (value / 255) ** gamma`, limited to 255."""

    gamma: float
    gain: float

    def table(self) -> Image:
        """Return the curve as a table, shape (256,), uint8."""
        values = 255.0 * self.gain * (np.arange(256) / 255.0) ** self.gamma
        return np.minimum(np.floor(values + 0.5), 255.0).astype(np.uint8)


@dataclass(frozen=True)
class PatchPlan:
    """Settings for cutting a line.

    Attributes:
        side_px: Side of the square windows after reduction.
        reductions: (pings, samples) averaged into one pixel; one set of windows for each.
        per_reduction: Maximum number of windows for a line and a reduction, scattered over the line.
        least_std: Windows with a smaller standard deviation (grey levels, before stretching) show no seabed and are
            skipped.
        tones: Assigned to the windows in turn.
        copies: Uses of each window, each with the next tone and another mirroring.
    """

    side_px: int = 80
    reductions: tuple[tuple[int, int], ...] = ((1, 1), (2, 2), (3, 3), (4, 4), (2, 1), (4, 2), (6, 6))
    per_reduction: int = 250
    least_std: float = 12.0
    tones: tuple[ToneMapping, ...] = field(
        default=(
            ToneMapping(1.0, 1.0),
            ToneMapping(1.3, 0.9),
            ToneMapping(1.7, 0.8),
            ToneMapping(0.85, 0.8),
            ToneMapping(1.5, 0.6),
            ToneMapping(1.2, 1.15),
            ToneMapping(2.0, 0.95),
        )
    )
    copies: int = 1


def stretch(window: npt.NDArray[np.float64], low_percent: float = 1.0, high_percent: float = 99.5) -> Image:
    """Map a window to 8 bits: the two percentiles become 0 and 255, values beyond are clipped.

    Percentiles are order statistics without interpolation, so the result is the same on all machines.
    """
    ordered = np.sort(window, axis=None)
    low = float(ordered[int((ordered.size - 1) * low_percent / 100)])
    high = float(ordered[int((ordered.size - 1) * high_percent / 100)])
    span = high - low if high > low else 1.0
    scaled = np.floor((window - low) * 255.0 / span + 0.5)
    return np.clip(scaled, 0.0, 255.0).astype(np.uint8)


def reduce_line(line: SonarLine, pings: int, samples: int) -> npt.NDArray[np.float64]:
    """Average blocks of (pings, samples). The remainder at the far edges is dropped."""
    rows, columns = line.shape[0] // pings, line.shape[1] // samples
    blocks = line[: rows * pings, : columns * samples].astype(np.float64).reshape(rows, pings, columns, samples)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float64)


def cut_line(name: str, line: SonarLine, plan: PatchPlan) -> Iterator[TrainingImage]:
    """Cut one side of a survey line into training images.

    Args:
        name: Name of the line, the start of the image names.
        line: Shape (pings, samples), float32; NaN for missing samples.
        plan: Settings.
    """
    tables = [tone.table() for tone in plan.tones]
    serial = 0
    for pings, samples in plan.reductions:
        reduced = reduce_line(line, pings, samples)
        for top, left in _scattered(_usable_corners(reduced, plan), plan.per_reduction):
            window = stretch(reduced[top : top + plan.side_px, left : left + plan.side_px])
            for _ in range(plan.copies):
                yield _variant(f"{name} {pings}x{samples} at {top},{left} #{serial}", window, serial, tables)
                serial += 1


def cut_around(
    name: str, line: SonarLine, places: Sequence[tuple[int, int]], plan: PatchPlan
) -> Iterator[TrainingImage]:
    """Cut a window around each place, for rare objects on the seabed and their shadows.

    Args:
        name: Name of the line, the start of the image names.
        line: As for `cut_line`.
        places: (ping, sample) of each object, placed off the centre of its windows in varying directions.
        plan: Settings; `per_reduction` and `least_std` do not apply.
    """
    tables = [tone.table() for tone in plan.tones]
    # All different modulo the side of a tile.
    offsets = ((0, 0), (3, -9), (-7, 5), (9, 8), (-4, -13), (13, -3), (-11, 11))
    serial = 0
    for pings, samples in plan.reductions:
        reduced = reduce_line(line, pings, samples)
        if min(reduced.shape) < plan.side_px:
            continue
        for ping, sample in places:
            for _ in range(plan.copies):
                down, right = offsets[serial % len(offsets)]
                top = min(max(ping // pings - plan.side_px // 2 + down, 0), reduced.shape[0] - plan.side_px)
                left = min(max(sample // samples - plan.side_px // 2 + right, 0), reduced.shape[1] - plan.side_px)
                window = reduced[top : top + plan.side_px, left : left + plan.side_px]
                if np.isfinite(window).all():
                    label = f"{name} object {pings}x{samples} at {top},{left} #{serial}"
                    yield _variant(label, stretch(window), serial, tables)
                serial += 1


def shuffled(images: Sequence[TrainingImage]) -> list[TrainingImage]:
    """Return the images in an order that mixes lines and scales and depends only on their names."""
    return sorted(images, key=lambda image: hashlib.sha256(image.name.encode()).digest())


def _usable_corners(line: npt.NDArray[np.float64], plan: PatchPlan) -> list[tuple[int, int]]:
    corners = []
    for top in range(0, line.shape[0] - plan.side_px + 1, plan.side_px):
        for left in range(0, line.shape[1] - plan.side_px + 1, plan.side_px):
            window = line[top : top + plan.side_px, left : left + plan.side_px]
            if np.isfinite(window).all() and float(window.std()) >= plan.least_std:
                corners.append((top, left))
    return corners


def _scattered(corners: list[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Return the first `count` corners by hash. Even steps could repeat the same column, such as the nadir."""
    return sorted(corners, key=lambda corner: hashlib.sha256(repr(corner).encode()).digest())[:count]


def _variant(name: str, window: Image, serial: int, tables: Sequence[Image]) -> TrainingImage:
    """Return a mirrored copy of a window in one of the tones."""
    mirrored = window[:: -1 if serial & 1 else 1, :: -1 if serial & 2 else 1]
    # The extra step after each cycle of tones changes the combination of tone and mirroring.
    pixels = np.ascontiguousarray(tables[(serial + serial // len(tables)) % len(tables)][mirrored])
    return TrainingImage(name, lambda: pixels)
