"""`python -m research.edge_blur`: error of lengths that are measured on decoded images, by bytes a pixel.

Objects of known length and shadow on Rayleigh-distributed seabed are encoded with the codec emb. On the decoded image,
least squares fit a box of constant grey to the mean profile of the object; its edges give the length. The command
prints the table of `sonarpost.review.edge_blur`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from research.common.command import add_strength_argument, command_parser, report_progress, run_command
from sonarpost.codec.emb.codec import EmbCodec

HEIGHT_PX, WIDTH_PX = 80, 140
BYTES: Final = (24, 48, 64, 96, 128, 192, 314, 629)
COVERED: Final = 0.683
"""Probability of an error of at most one standard deviation."""

_HIGHLIGHT: Final = (2.5, 5.0)
_SHADOW: Final = (0.2, 0.5)
"""Range of the mean amplitude of highlight and shadow, relative to the seabed."""
_MARGIN_PX: Final = 9

Image = npt.NDArray[np.uint8]
Vector = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class KnownObject:
    """An image with an object of known extent, in pixels from the upper left corner.

    Attributes:
        image: Shape (80, 140), uint8.
        rows: First and last edge of object and shadow along-track.
        columns: First and last edge of the highlight across-track.
        shadow_end: Column of the end of the shadow, which begins at the last edge of the highlight.
    """

    image: Image
    rows: tuple[float, float]
    columns: tuple[float, float]
    shadow_end: float


def known_objects(count: int, seed: int) -> Iterator[KnownObject]:
    """Yield objects of 6 to 24 rows and 6 to 20 columns with shadows of 15 to 50 columns."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        length, width, shadow = rng.uniform(6, 24), rng.uniform(6, 20), rng.uniform(15, 50)
        top, left = HEIGHT_PX / 2 - length / 2 + rng.uniform(-1, 1), WIDTH_PX / 4 + rng.uniform(-1, 1)
        along = _cover(HEIGHT_PX, top, top + length)
        highlight = np.outer(along, _cover(WIDTH_PX, left, left + width))
        dark = np.outer(along, _cover(WIDTH_PX, left + width, left + width + shadow))
        mean = 1.0 + (rng.uniform(*_HIGHLIGHT) - 1.0) * highlight + (rng.uniform(*_SHADOW) - 1.0) * dark
        root = np.sqrt(mean * rng.rayleigh(1.0, mean.shape))
        low, high = np.percentile(root, (0.5, 99.5))
        grey = np.clip(np.rint(255 * (root - low) / (high - low)), 0, 255).astype(np.uint8)
        yield KnownObject(grey, (top, top + length), (left, left + width), left + width + shadow)


def _cover(size: int, first: float, last: float) -> Vector:
    """Return the fraction of each pixel between two edges."""
    edges = np.arange(size + 1, dtype=np.float64)
    return np.diff(np.clip(edges, first, last))


def measured_edges(profile: Vector, first: float, last: float, *, dark: bool = False) -> tuple[float, float]:
    """Return the edges of a box of constant level in a profile, by least squares.

    Args:
        profile: Grey levels; element i covers i to i + 1.
        first: Approximate first edge, as an operator sees it.
        last: Approximate last edge.
        dark: Whether the box is darker than its surroundings.
    """
    begin = max(0, round(first) - _MARGIN_PX)
    values = profile[begin : min(profile.shape[0], round(last) + _MARGIN_PX)] * (-1.0 if dark else 1.0)
    count = values.shape[0]
    total = np.concatenate([[0.0], np.cumsum(values)])
    best, edges = -math.inf, (0, count)
    for start in range(count - 1):
        for end in range(start + 2, count + 1):
            inside = end - start
            if inside == count:
                continue
            mean_in, mean_out = (
                (total[end] - total[start]) / inside,
                (total[-1] - total[end] + total[start]) / (count - inside),
            )
            gain = inside * (count - inside) / count * (mean_in - mean_out) ** 2
            if mean_in > mean_out and gain > best:
                best, edges = gain, (start, end)
    return begin + edges[0], begin + edges[1]


def length_errors(known: KnownObject, image: Image) -> tuple[float, float]:
    """Return the errors in pixels of the length along-track and of the shadow across-track, measured on an image."""
    grey = image.astype(np.float64)
    (top, bottom), (left, right) = known.rows, known.columns
    along = grey[:, round(left) : round(right)].mean(axis=1)
    found = measured_edges(along, top, bottom)
    length_error = (found[1] - found[0]) - (bottom - top)
    across = grey[round(top) : round(bottom)].mean(axis=0)
    # The highlight would be brighter than the box's surroundings on one side: it is limited to the seabed's level.
    across = np.minimum(across, np.median(across))
    found = measured_edges(across, right, known.shadow_end, dark=True)
    return length_error, (found[1] - found[0]) - (known.shadow_end - right)


def blur_rows(objects: Sequence[KnownObject], strength: float) -> list[tuple[float, float, float]]:
    """Return (bytes a pixel, 68.3 % quantile of the length error in pixels, the same for an edge), not rising."""
    codec = EmbCodec(strength=strength)
    errors: dict[int, list[float]] = {size: [] for size in BYTES}
    for number, known in enumerate(objects):
        stream = codec.encode(known.image, BYTES[-1])
        for size in BYTES:
            errors[size] += length_errors(known, codec.decode(stream[:size]).image)
        if number % 20 == 19:
            report_progress(f"{number + 1} of {len(objects)} objects")
    rows = []
    limit = math.inf
    for size in BYTES:
        limit = min(limit, float(np.quantile(np.abs(errors[size]), COVERED)))
        rows.append((size / (HEIGHT_PX * WIDTH_PX), limit, limit / math.sqrt(2)))
    return rows


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser("edge_blur", "Error of lengths measured on images of the codec emb, by bytes a pixel.")
    parser.add_argument(
        "--objects", type=int, default=300, metavar="N", help="simulated objects (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of all random draws (default: %(default)s)")
    add_strength_argument(parser)
    return parser


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    print("bytes  bytes/pixel  length error px  edge px")
    rows = blur_rows(list(known_objects(args.objects, args.seed)), args.strength)
    for size, (density, length_px, edge_px) in zip(BYTES, rows, strict=True):
        print(f"{size:5d}  {density:11.5f}  {length_px:15.2f}  {edge_px:7.2f}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
