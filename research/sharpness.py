"""`python -m research.sharpness`: smallest detail of decoded images, by bytes a pixel.

Simulated contacts are encoded with the codec emb and default despeckling. The scene without speckle is blurred with the
Gaussian that makes it most similar to the decoded image (least squares); the full width of this Gaussian at half of its
maximum is the smallest detail. The command prints the table of `sonarpost.review.resolution`.
"""

import argparse
import math
import statistics
import sys
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from research.common.command import command_parser, report_progress, run_command
from research.common.images import simulated_images
from sonarpost.codec import emb
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.review.resolution import FULL_WIDTH

BYTES: Final = (16, 24, 48, 72, 96, 144, 192, 320, 640, 1280)
SIGMAS_PX: Final = np.geomspace(0.2, 20.0, 60)

Image = npt.NDArray[np.uint8]


def blur_sigma_px(scene: Image, decoded: Image) -> float:
    """Return the standard deviation in pixels of the Gaussian blur that makes a scene most similar to an image.

    A gain and an offset of the image do not count.

    Args:
        scene: Shape (height_px, width_px), without speckle.
        decoded: Same shape.
    """
    wanted = decoded.astype(np.float64).ravel()
    wanted -= wanted.mean()

    def error(sigma_px: float) -> float:
        blurred = gaussian_filter(scene.astype(np.float64), sigma_px).ravel()
        blurred -= blurred.mean()
        power = float(blurred @ blurred)
        gain = float(blurred @ wanted) / power if power > 0 else 0.0
        return float(((wanted - gain * blurred) ** 2).sum())

    return float(min(SIGMAS_PX, key=error))


def measure(images: int, budgets: Sequence[int]) -> list[tuple[float, float]]:
    """Return (bytes a pixel, median of the smallest detail in pixels) for each length."""
    samples = [sample for sample in simulated_images(images, with_scenes=True).images if sample.clean is not None]
    codec = EmbCodec(strength=emb.DEFAULT_STRENGTH)
    table: list[tuple[float, float]] = []
    for budget in budgets:
        widths: list[float] = []
        for sample in samples:
            assert sample.clean is not None
            decoded = codec.decode(codec.encode(sample.pixels, budget)).image
            widths.append(FULL_WIDTH * blur_sigma_px(sample.clean, decoded))
        density = budget / math.prod(samples[0].pixels.shape)
        table.append((density, statistics.median(widths)))
        report_progress(f"{budget} bytes")
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = command_parser("sharpness", __doc__ or "")
    parser.add_argument("--images", type=int, default=60, help="simulated contacts, 1 to 1000 (default: 60)")

    def run(parsed: argparse.Namespace) -> int:
        for density, width_px in measure(min(1000, max(1, parsed.images)), BYTES):
            print(f"({density:.5f}, {width_px:.1f}),")
        return 0

    return run_command(parser, run, arguments)


if __name__ == "__main__":
    sys.exit(main())
