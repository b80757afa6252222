"""Trial: a learned lifting step after each level of the 9/7 wavelet.

    python -m research.training.emb.trials.learned_lifting --data DIR

A step predicts each high band of a level from 6 x 6 cells of its low band; the coder codes the difference. Fitted by
least squares on the training crops. Printed are the energy of the test crops' high bands that the steps, and nonlinear
predictions, remove, and the PSNR of the coder with the steps.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from unittest.mock import patch

import numpy as np
import numpy.typing as npt

from research.common.command import command_parser, run_command
from research.common.images import sdvd_crops
from research.common.quality import psnr_db
from sonarpost.codec.emb import transform
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.kernel import I32
from sonarpost.codec.emb.transform import HEIGHT, LEVEL, ORIENT, WIDTH, Layout, Plane, layout_of
from sonarpost.codec.interface import Image

Floats = npt.NDArray[np.float64]
Taps = dict[tuple[int, int], Floats]
"""Weights of 36 cells of the low band, by level and orientation of the predicted band."""
REACH: Final = range(-2, 4)
_RANDOM_UNITS: Final = 150
_MAX_EXAMPLES: Final = 400_000


def low_cells(low: Plane, rows: int, columns: int) -> Floats:
    """Return the 36 cells of the low band around each cell of a high band, shape (rows * columns, 36)."""
    padded = np.pad(low.astype(np.float64), ((2, 4), (2, 4)), mode="edge")
    cells = [padded[2 + i : 2 + i + rows, 2 + j : 2 + j + columns] for i in REACH for j in REACH]
    return np.stack(cells, -1).reshape(rows * columns, len(REACH) ** 2)


def bands_with_cells(
    coefficients: Plane, source: Plane, layout: Layout, level: int
) -> Iterator[tuple[int, Plane, Floats]]:
    """Yield orientation, coefficients (a view) and cells of the low band of `source`, of the high bands of a level."""
    low_h, low_w = layout.sides[level].tolist()
    low = transform.inverse(source, layout, level)[0][:low_h, :low_w]
    for band in layout.bands.tolist()[1:]:
        if band[LEVEL] == level and band[HEIGHT] and band[WIDTH]:
            top, left = low_h * (band[ORIENT] != transform.HL), low_w * (band[ORIENT] != transform.LH)
            view = coefficients[top : top + band[HEIGHT], left : left + band[WIDTH]]
            yield band[ORIENT], view, low_cells(low, *view.shape)


def add_predictions(coefficients: Plane, layout: Layout, taps: Taps, sign: int) -> Plane:
    """Return the coefficients with the predictions of all high bands added (sign 1), or subtracted (-1); rounded."""
    out = coefficients.copy()
    for level in range(layout.levels, 0, -1):
        for orient, band, cells in bands_with_cells(out, out if sign > 0 else coefficients, layout, level):
            band[:] += sign * np.rint(cells @ taps[level, orient]).astype(np.int64).reshape(band.shape)
    return out


@contextmanager
def learned_steps(taps: Taps) -> Iterator[None]:
    """Let the coder use the steps. Its optimisation of the targets takes the gradient without them."""
    forward, inverse = transform.forward, transform.inverse

    def own_inverse(coefficients: Plane, layout: Layout, down_to: int = 0) -> tuple[Plane, I32]:
        with patch.object(transform, "inverse", inverse):
            return inverse(add_predictions(coefficients, layout, taps, 1), layout, down_to)

    def own_forward(image: Plane, layout: Layout) -> Plane:
        with patch.object(transform, "inverse", inverse):
            return add_predictions(forward(image, layout), layout, taps, -1)

    with patch.object(transform, "inverse", own_inverse), patch.object(transform, "forward", own_forward):
        yield


def examples(images: Sequence[Image]) -> dict[tuple[int, int], tuple[Floats, Floats]]:
    """Return low-band cells and coefficients of many images of one size, by level and orientation."""
    found: dict[tuple[int, int], list[tuple[Floats, Plane]]] = {}
    layout = layout_of(*images[0].shape)
    for image in images:
        plane = transform.forward((image.astype(np.int64) - int(image.mean())) * transform.UNIT, layout)
        for level in range(1, layout.levels + 1):
            for orient, band, cells in bands_with_cells(plane, plane, layout, level):
                found.setdefault((level, orient), []).append((cells, band.ravel()))
    return {
        key: (np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]).astype(np.float64))
        for key, parts in found.items()
    }


def least_squares(inputs: Floats, values: Floats) -> Floats:
    """Return the weights of the least squared error, slightly regularised."""
    normal = inputs.T @ inputs
    normal += 1e-4 * normal.trace() / len(normal) * np.eye(len(normal))
    return np.asarray(np.linalg.solve(normal, inputs.T @ values))


def with_rectified(cells: Floats) -> Floats:
    """Return the cells and random rectified sums of them, inputs of a nonlinear prediction."""
    weights = np.random.default_rng(0).normal(0, 1, (cells.shape[1], _RANDOM_UNITS))
    return np.concatenate([cells, np.maximum((cells - cells.mean(1, keepdims=True)) @ weights, 0)], 1)


def run(args: argparse.Namespace) -> int:
    """Fit the steps, print the energy that they remove, code the test crops."""
    folder = args.data / "snippets" / "sdvd"
    train, test = ([image.pixels for image in sdvd_crops(folder, split).images] for split in ("train", "test"))
    held_out, taps = examples(test), dict[tuple[int, int], Floats]()
    for key, (cells, values) in examples(train).items():
        taps[key], own = least_squares(cells, values), held_out[key]
        pick = np.random.default_rng(1).permutation(len(values))[:_MAX_EXAMPLES]
        nonlinear = with_rectified(own[0]) @ least_squares(with_rectified(cells[pick]), values[pick])
        change = [100 * (((own[1] - g) ** 2).sum() / (own[1] ** 2).sum() - 1) for g in (own[0] @ taps[key], nonlinear)]
        print(f"level, orientation {key}: energy {change[0]:+.2f} %, nonlinear {change[1]:+.2f} %", flush=True)
    codec = EmbCodec()
    for budget in args.budgets:
        plain = np.mean([psnr_db(image, codec.decode(codec.encode(image, budget)).image) for image in test])
        with learned_steps(taps):
            own_db = np.mean([psnr_db(image, codec.decode(codec.encode(image, budget)).image) for image in test])
        print(
            f"{len(test)} images, {budget} B: {plain:.3f} dB, with learned steps {own_db - plain:+.3f} dB", flush=True
        )
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    parser = command_parser("training.emb.trials.learned_lifting", __doc__ or "")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--budgets", type=int, nargs="+", default=[64, 128])
    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
