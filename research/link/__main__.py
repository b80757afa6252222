"""`python -m research.link`: quality of images over a lossy channel, by transmission scheme, at equal bytes."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from research.common.command import command_parser, report_progress, run_command, warn
from research.common.images import ImageSet, read_image_folder, simulated_images
from research.link.schemes import (
    Codecs,
    LinkImage,
    SchemeResult,
    Setting,
    bound_rates,
    feedback_stream_bytes,
    pooled_bound_db,
    run_bound,
    run_paper,
    run_sequential,
    run_v1,
)
from sonarpost.errors import ConfigError
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.frames.v1.frame import MAX_FRAME_BYTES, MIN_FRAME_BYTES

_Row = dict[str, object]
_Scheme = Callable[[Sequence[LinkImage], Codecs, Setting], SchemeResult]
_DEFAULT_IMAGES: Final = 200
_STREAM_FACTOR: Final = 2
"""Ratio of stream length to the bytes of an image's frames: within a group, difficult images receive more bytes."""


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "link",
        description="Send images over a simulated lossy channel with the paper's halves, a sequential embedded "
        "stream, and the wire format v1 without and with feedback, at equal bytes, and compare with the erasure bound.",
    )
    parser.add_argument(
        "--loss", default="0.1,0.3,0.5", metavar="P,…", help="shares of frames lost (default: %(default)s)"
    )
    parser.add_argument(
        "--burst",
        default="1,4",
        metavar="N,…",
        help="mean frames lost in a row, 1 = independent (default: %(default)s)",
    )
    parser.add_argument("--frames", type=int, default=6, metavar="N", help="frames an image (default: %(default)s)")
    parser.add_argument("--frame-bytes", type=int, default=64, metavar="N", help="bytes a frame (default: %(default)s)")
    parser.add_argument(
        "--images",
        default=str(_DEFAULT_IMAGES),
        metavar="DIR|N",
        help="folder, or number of simulated images (%(default)s)",
    )
    parser.add_argument(
        "--groups", metavar="N,…", help="also compare v1 broadcast with these numbers of images coded jointly"
    )
    parser.add_argument("--depth", type=int, default=2, metavar="N", help="groups interleaved (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of images and losses (default: 0)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    return parser


def _numbers(option: str, text: str, low: float, high: float) -> list[float]:
    """Parse `0.1,0.3`.

    Raises:
        ConfigError: A part is not a number in the range.
    """
    found = []
    for part in text.split(","):
        try:
            value = float(part)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise ConfigError("link", option, part, f"numbers {low}..{high}, separated by commas")
        found.append(value)
    return found


def _images(args: argparse.Namespace) -> ImageSet:
    count_or_folder: str = args.images
    if count_or_folder.isascii() and count_or_folder.isdigit():
        return simulated_images(int(count_or_folder), args.seed)
    found = read_image_folder(Path(count_or_folder))
    for line in found.rejected:
        warn(f"rejected: {line}")
    return found


def run(args: argparse.Namespace) -> int:
    """Measure and report; return 0.

    Raises:
        SonarpostError: Invalid options or folders.
    """
    losses = _numbers("--loss", args.loss, 0.0, 0.9)
    bursts = _numbers("--burst", args.burst, 1.0, 1000.0)
    groups = [] if args.groups is None else [int(n) for n in _numbers("--groups", args.groups, 1, 120)]
    for option, value, low, high in (
        ("--frames", args.frames, 2, 64),
        ("--frame-bytes", args.frame_bytes, MIN_FRAME_BYTES, MAX_FRAME_BYTES),
        ("--depth", args.depth, 1, 4),
        ("--seed", args.seed, 0, 1_000_000),
    ):
        if not low <= value <= high:
            raise ConfigError("link", option, value, f"{low}..{high}")
    measured = _images(args)
    codecs = Codecs.shipped()
    report_progress(f"coding {len(measured.images)} images of {measured.origin}")
    stream_bytes = _STREAM_FACTOR * args.frames * args.frame_bytes
    images = [codecs.code(image.pixels, n, stream_bytes) for n, image in enumerate(measured.images)]
    rows: list[_Row] = []
    for burst in bursts:
        for loss in losses:
            report_progress(f"loss {loss}, burst {burst}")
            setting = Setting(args.frames, args.frame_bytes, LossChannel(loss, burst), 0, args.depth, args.seed)
            rows += measure_setting(images, codecs, setting, groups)
    if args.json:
        print(json.dumps({"images": len(images), "results": rows}, allow_nan=False))
    else:
        print(table(rows, f"{len(images)} images of {measured.origin}, {args.frames} frames of {args.frame_bytes} B"))
    return 0


def _broadcast(images: Sequence[LinkImage], codecs: Codecs, setting: Setting) -> SchemeResult:
    return run_v1(images, codecs, setting, feedback=False)


def _feedback(images: Sequence[LinkImage], codecs: Codecs, setting: Setting) -> SchemeResult:
    return run_v1(images, codecs, setting, feedback=True)


def measure_setting(
    images: Sequence[LinkImage], codecs: Codecs, setting: Setting, groups: Sequence[int] = ()
) -> list[_Row]:
    """Return a row for each scheme under one condition."""
    schemes: list[tuple[str, _Scheme, Setting]] = [
        ("paper", run_paper, setting),
        ("sequential", run_sequential, setting),
        ("v1-broadcast", _broadcast, setting),
        *((f"v1-broadcast, groups of {n}", _broadcast, replace(setting, group=n)) for n in groups),
        ("v1-feedback", _feedback, setting),
        ("bound", run_bound, setting),
    ]
    rows = [_row(name, scheme(images, codecs, own), own) for name, scheme, own in schemes]
    rows[-1]["preview_rate"], rows[-1]["complete_rate"] = (round(r, 5) for r in bound_rates(setting))
    rows[-1]["pooled_psnr"] = round(pooled_bound_db(images, codecs, setting), 4)
    rows[-1]["airtime_ratio"] = 1.0
    return rows


def _row(scheme: str, result: SchemeResult, setting: Setting) -> _Row:
    delivered = result.delivered
    payload = sum(d.payload_bytes for d in delivered)
    # The capacity of an erasure channel is 1 - loss (Elias, "Coding for two noisy channels", 1955).
    bound_frames = payload / (setting.frame_bytes * (1.0 - setting.channel.loss))
    return {
        "scheme": scheme,
        "loss": setting.channel.loss,
        "burst": setting.channel.burst,
        "bytes": round(result.frames * setting.frame_bytes / len(delivered), 2),
        "psnr": round(float(np.mean([d.quality.psnr for d in delivered])), 4),
        "ssim": round(float(np.mean([d.quality.ssim for d in delivered])), 5),
        "preview_rate": round(float(np.mean([d.has_preview for d in delivered])), 5),
        "complete_rate": round(float(np.mean([d.is_complete for d in delivered])), 5),
        "airtime_ratio": round(result.frames / bound_frames, 4) if bound_frames > 0 else None,
        "frames": result.frames,
        "reports": result.reports,
        **({"stream_bytes": feedback_stream_bytes(setting)} if scheme == "v1-feedback" else {}),
    }


def table(rows: Sequence[_Row], title: str) -> str:
    """Return the rows as text."""
    names = ("loss", "burst", "bytes", "PSNR", "SSIM", "preview", "complete", "air")
    widths = (5, 5, 7, 6, 6, 8, 8, 6)
    heads = " ".join(f"{name:>{width}}" for name, width in zip(names, widths, strict=True))
    lines = [title, f"{'scheme':28} {heads}"]
    for row in rows:
        values = [row[name] for name in ("bytes", "psnr", "ssim", "preview_rate", "complete_rate", "airtime_ratio")]
        numbers = [float(v) if isinstance(v, (int, float)) else float("nan") for v in values]
        cells = "{:7.1f} {:6.2f} {:6.3f} {:8.4f} {:8.4f} {:6.3f}".format(*numbers)
        lines.append(f"{row['scheme']:28} {row['loss']:5} {row['burst']:5} {cells}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
