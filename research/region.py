"""`python -m research.region`: PSNR inside a box by the way in which further bytes of an image are spent.

The vessel has the first bytes of the stream of the whole image (`--base`). Further bytes can continue this stream
(refine), begin a stream of the whole image with a region of interest, or code the box alone. The region of interest is
side information at the start of a stream, so a stream that has begun cannot be continued with one.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from research.common.command import command_parser, run_command
from research.common.emb_estimate import encode_with_estimate
from research.common.images import sdvd_crops
from research.common.scene_measures import clipped_psnr_db
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.side_info import SIXTEENTHS, RegionOfInterest
from sonarpost.codec.interface import Image
from sonarpost.codec.region import BOX_STEPS, RegionBox

BOXES: Final = {"3/8 of the sides": RegionBox(10, 10, 22, 22), "1/2 of the sides": RegionBox(8, 8, 24, 24)}
"""Boxes around the centre, where the target is."""
BYTES: Final = (48, 96, 192)


def measure(
    image: Image, box: RegionBox, base_bytes: int, more_bytes: int, codec: EmbCodec
) -> tuple[float, float, float]:
    """Return the PSNR inside a box in dB: stream continued, region of interest, the box alone."""
    top, left, bottom, right = box.pixels(*image.shape)
    inside = image[top:bottom, left:right]
    continued = codec.extend(codec.encode(image, base_bytes), image, base_bytes + more_bytes)
    step = BOX_STEPS // SIXTEENTHS
    region = RegionOfInterest(box.top // step, box.left // step, (box.bottom - 1) // step, (box.right - 1) // step)
    weighted = encode_with_estimate(codec, image, more_bytes, region=region).stream
    alone = codec.encode(inside, more_bytes)
    whole = [codec.decode(stream).image[top:bottom, left:right] for stream in (continued, weighted)]
    return (
        clipped_psnr_db(inside, whole[0]),
        clipped_psnr_db(inside, whole[1]),
        clipped_psnr_db(inside, codec.decode(alone).image),
    )


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser("region", "PSNR inside a box by the way in which further bytes are spent")
    parser.add_argument("folder", help="SDVD data set")
    parser.add_argument("--base", type=int, default=131, help="bytes of the stream that the vessel has (%(default)s)")
    parser.add_argument("--images", type=int, default=40, help="maximum number of images (%(default)s)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Measure and print the means."""
    images = [each.pixels for each in sdvd_crops(Path(args.folder)).images if each.is_target][: args.images]
    codec = EmbCodec(strength=0.0)
    print(f"{len(images)} images, {args.base} B received; PSNR inside the box in dB")
    print(f"{'box':18} {'further B':>9} {'refine':>8} {'region of interest':>19} {'box alone':>10}")
    for name, box in BOXES.items():
        for more_bytes in BYTES:
            found = np.array([measure(image, box, args.base, more_bytes, codec) for image in images])
            refined, weighted, alone = found.mean(axis=0)
            print(f"{name:18} {more_bytes:9} {refined:8.2f} {weighted:19.2f} {alone:10.2f}")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    raise SystemExit(main())
