"""The contact sheet: every picture as it was, as it was sent, as the vessel has it, as the shore has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from sonarpost.codec.interface import to_uint8

COLUMNS = ("original", "as sent", "received on the vessel", "received ashore")
BACKGROUND, INK, FAINT, MISSING = (16, 20, 26), (232, 236, 240), (140, 150, 160), (200, 70, 60)
SCALE = 2
MARGIN, GAP, CAPTION, HEADER = 24, 16, 54, 84
MAX_ROWS = 12

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True)
class SheetRow:
    """One contact on the sheet; a picture that does not exist is None."""

    title: str
    detail: str
    pictures: tuple[Picture | None, Picture | None, Picture | None, Picture | None]
    missing: tuple[npt.NDArray[np.bool_] | None, ...]


def write_sheet(path: Path, title: str, rows: Sequence[SheetRow]) -> None:
    """Draw the sheet, most interesting rows first as given, at most 12 of them."""
    shown = rows[:MAX_ROWS]
    width_px = max((p.shape[1] for row in shown for p in row.pictures if p is not None), default=140) * SCALE
    heights = [max((p.shape[0] for p in row.pictures if p is not None), default=80) * SCALE for row in shown]
    total_width = 2 * MARGIN + len(COLUMNS) * width_px + (len(COLUMNS) - 1) * GAP
    total_height = HEADER + sum(h + CAPTION for h in heights) + MARGIN + (24 if len(rows) > MAX_ROWS else 0)
    sheet = Image.new("RGB", (max(total_width, 720), total_height), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, 14), title, fill=INK, font=ImageFont.load_default(20))
    for column, name in enumerate(COLUMNS):
        draw.text((MARGIN + column * (width_px + GAP), 50), name, fill=FAINT, font=ImageFont.load_default(15))
    top = HEADER
    for row, height_px in zip(shown, heights, strict=True):
        for column in range(len(COLUMNS)):
            left = MARGIN + column * (width_px + GAP)
            _paste(sheet, (left, top), row.pictures[column], row.missing[column], (width_px, height_px))
        draw.text((MARGIN, top + height_px + 6), row.title, fill=INK, font=ImageFont.load_default(14))
        draw.text((MARGIN, top + height_px + 25), row.detail, fill=FAINT, font=ImageFont.load_default(13))
        top += height_px + CAPTION
    if len(rows) > MAX_ROWS:
        more = f"and {len(rows) - MAX_ROWS} more, in the folders beside this sheet"
        draw.text((MARGIN, top), more, fill=FAINT, font=ImageFont.load_default(14))
    sheet.save(path)


def _paste(
    sheet: Image.Image,
    corner: tuple[int, int],
    picture: Picture | None,
    missing: npt.NDArray[np.bool_] | None,
    box: tuple[int, int],
) -> None:
    if picture is None:
        draw = ImageDraw.Draw(sheet)
        draw.rectangle((corner[0], corner[1], corner[0] + box[0] - 1, corner[1] + box[1] - 1), outline=MISSING)
        draw.text((corner[0] + 12, corner[1] + 12), "nothing received", fill=MISSING, font=ImageFont.load_default(14))
        return
    colour = np.repeat(to_uint8(picture)[:, :, None], 3, axis=2)
    if missing is not None and missing.any():
        # Thin diagonal lines say "no data" where plain black could pass for a shadow.
        rows, columns = np.indices(missing.shape)
        colour[missing & ((rows + columns) % 8 == 0)] = MISSING
    tile = Image.fromarray(colour).resize(
        (picture.shape[1] * SCALE, picture.shape[0] * SCALE), Image.Resampling.NEAREST
    )
    sheet.paste(tile, corner)
