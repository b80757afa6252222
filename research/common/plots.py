"""Plots and image sheets. matplotlib is an optional extra and is imported for plots only."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

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


@dataclass(frozen=True)
class SheetCell:
    """One image of a sheet; `image` is None if the codec missed it."""

    image: Image | None
    caption: str
    detail: str = ""


def write_sheet(
    path: Path, title: str, rows: Sequence[Sequence[SheetCell]], scale: int = 2, *, is_grey: bool = False
) -> None:
    """Draw images in rows, enlarged by pixel replication, with captions below.

    Args:
        path: PNG to create or replace.
        title: Line at the top.
        rows: The cells; rows may differ in length.
        scale: Enlargement.
        is_grey: Whether to save grey levels, a third smaller, instead of colours.

    Raises:
        OSError: The file cannot be written.
    """
    shapes = [cell.image.shape for row in rows for cell in row if cell.image is not None]
    width_px = max([shape[1] * scale for shape in shapes] + [150])
    heights = [max([cell.image.shape[0] * scale for cell in row if cell.image is not None] + [60]) for row in rows]
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
    (sheet.convert("L") if is_grey else sheet).save(buffer, format="PNG", optimize=is_grey)
    write_atomically(path, buffer.getvalue())


def _draw_cell(
    sheet: PillowImage.Image,
    draw: ImageDraw.ImageDraw,
    cell: SheetCell,
    box: tuple[int, int, int, int],
    scale: int,
) -> None:
    left, top, width_px, height_px = box
    if cell.image is None:
        draw.rectangle((left, top, left + width_px - 1, top + height_px - 1), outline=_MISS)
        draw.text((left + 8, top + 8), "does not fit", fill=_MISS, font=ImageFont.load_default(13))
    else:
        shape = (cell.image.shape[1] * scale, cell.image.shape[0] * scale)
        image = PillowImage.fromarray(np.ascontiguousarray(cell.image))
        sheet.paste(image.resize(shape, PillowImage.Resampling.NEAREST), (left, top))
    draw.text((left, top + height_px + 4), cell.caption, fill=_INK, font=ImageFont.load_default(13))
    draw.text((left, top + height_px + 20), cell.detail, fill=_FAINT, font=ImageFont.load_default(12))
