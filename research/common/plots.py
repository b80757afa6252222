"""Plots and picture sheets. matplotlib is an optional extra and is loaded only when a plot is asked for."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from research.codecs.rate_distortion import curves
from research.common.measurement import Point
from research.common.statistics import mean_of_known
from sonarpost.codec.interface import Image
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BACKGROUND, _INK, _FAINT, _MISS = (16, 20, 26), (232, 236, 240), (140, 150, 160), (200, 90, 80)
_MARGIN: Final = 20
_GAP: Final = 12
_CAPTION: Final = 44


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty matplotlib figure.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 (an optional extra, slow to load)
    except ImportError as error:
        raise ConfigError("research", "plot", "matplotlib is absent", "pip install 'sonarpost[research]'") from error
    return Figure(figsize=(width_in, height_in), dpi=110, layout="constrained")


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, atomically and without dates.

    Raises:
        OSError: The file cannot be written.
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_atomically(path, buffer.getvalue())


def plot_rate_distortion(points: Sequence[Point], title: str) -> Figure:
    """Draw PSNR, SSIM and MS-SSIM over real bytes, one line a codec; a budget with misses is an open marker.

    Raises:
        ConfigError: matplotlib is not installed.
    """
    figure = new_figure(15, 4.6)
    axes = figure.subplots(1, 3)
    markers = "osD^v<>Phd"
    for number, (name, curve) in enumerate(curves(points).items()):
        known = sorted((p for p in curve if p.hits.any()), key=lambda p: mean_of_known(p.stream_bytes))
        if not known:
            continue
        rates = [mean_of_known(p.stream_bytes) for p in known]
        for axis, values in zip(
            axes,
            ([p.psnr for p in known], [p.ssim for p in known], [p.msssim for p in known]),
            strict=True,
        ):
            marker = markers[number % len(markers)]
            style = "none" if known[0].subject.is_natural else "-"
            means = [mean_of_known(v) for v in values]
            (line,) = axis.plot(rates, means, linestyle=style, marker=marker, markersize=5, label=name)
            open_ones = [(r, m) for p, r, m in zip(known, rates, means, strict=True) if p.misses]
            if open_ones:
                x, y = zip(*open_ones, strict=True)
                axis.plot(x, y, "none", marker=marker, markersize=5, mfc="white", mec=line.get_color(), linestyle="")
    for axis, label in zip(axes, ("PSNR, dB", "SSIM", "MS-SSIM (3 scales)"), strict=True):
        axis.set_xscale("log", base=2)
        axis.set_xlabel("bytes a picture, header included")
        axis.set_ylabel(label)
        axis.grid(visible=True, alpha=0.3)
        ticks = [b for b in (8, 16, 32, 64, 128, 256, 512, 1024, 2048) if _in_range(b, axis.get_xlim())]
        axis.set_xticks(ticks, [str(b) for b in ticks])
    axes[0].legend(fontsize=8)
    figure.suptitle(title, fontsize=11)
    return figure


def _in_range(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


@dataclass(frozen=True)
class SheetCell:
    """One picture of a sheet; `picture` is None where the codec missed."""

    picture: Image | None
    caption: str
    detail: str = ""


def write_sheet(path: Path, title: str, rows: Sequence[Sequence[SheetCell]], scale: int = 2) -> None:
    """Draw pictures in rows, nearest-neighbour enlarged, with captions below.

    Args:
        path: PNG to create or replace.
        title: Line on top.
        rows: The cells; rows may differ in length.
        scale: Enlargement.

    Raises:
        OSError: The file cannot be written.
    """
    shapes = [cell.picture.shape for row in rows for cell in row if cell.picture is not None]
    width_px = max([shape[1] * scale for shape in shapes] + [150])
    heights = [max([cell.picture.shape[0] * scale for cell in row if cell.picture is not None] + [60]) for row in rows]
    columns = max(len(row) for row in rows)
    size = (2 * _MARGIN + columns * (width_px + _GAP), 56 + sum(h + _CAPTION for h in heights) + _MARGIN)
    sheet = PillowImage.new("RGB", size, _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((_MARGIN, 16), title, fill=_INK, font=ImageFont.load_default(17))
    top = 56
    for row, height_px in zip(rows, heights, strict=True):
        for column, cell in enumerate(row):
            left = _MARGIN + column * (width_px + _GAP)
            _draw_cell(sheet, draw, cell, (left, top, width_px, height_px), scale)
        top += height_px + _CAPTION
    buffer = io.BytesIO()
    sheet.save(buffer, format="PNG")
    write_atomically(path, buffer.getvalue())


def _draw_cell(
    sheet: PillowImage.Image,
    draw: ImageDraw.ImageDraw,
    cell: SheetCell,
    box: tuple[int, int, int, int],
    scale: int,
) -> None:
    left, top, width_px, height_px = box
    if cell.picture is None:
        draw.rectangle((left, top, left + width_px - 1, top + height_px - 1), outline=_MISS)
        draw.text((left + 8, top + 8), "does not fit", fill=_MISS, font=ImageFont.load_default(13))
    else:
        shape = (cell.picture.shape[1] * scale, cell.picture.shape[0] * scale)
        picture = PillowImage.fromarray(np.ascontiguousarray(cell.picture))
        sheet.paste(picture.resize(shape, PillowImage.Resampling.NEAREST), (left, top))
    draw.text((left, top + height_px + 4), cell.caption, fill=_INK, font=ImageFont.load_default(13))
    draw.text((left, top + height_px + 20), cell.detail, fill=_FAINT, font=ImageFont.load_default(12))
