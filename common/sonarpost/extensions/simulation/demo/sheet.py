"""The contact sheet: for each contact, its image at several stages side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from sonarpost.codec.interface import to_uint8

BACKGROUND, INK, FAINT, MISSING = (16, 20, 26), (232, 236, 240), (140, 150, 160), (200, 70, 60)
SCALE, MAX_SCALED_PX = 2, 256
"""Images of at most 256 px are drawn at twice their size; larger ones would make the sheet unreadable on a screen."""
MARGIN, GAP, GROUP_GAP, LABEL, CAPTION, HEADER = 24, 12, 40, 24, 56, 104
MAX_CONTACTS, CONTACTS_A_LINE = 12, 2


@dataclass(frozen=True)
class SheetCell:
    """One image of a contact.

    Attributes:
        label: Text below the image.
        image: Shape (height, width); None where there is none.
        missing: Pixels without data, same shape; they are hatched.
    """

    label: str = ""
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | None = None
    missing: npt.NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class SheetContact:
    """One contact: a cell for each stage, and two lines of text below them."""

    title: str
    detail: str
    cells: tuple[SheetCell, ...]


def write_sheet(path: Path, title: str, subtitle: str, stages: Sequence[str], contacts: Sequence[SheetContact]) -> None:
    """Write the sheet as PNG: the first 12 contacts, two side by side.

    Args:
        path: Where to write.
        title: First line.
        subtitle: Second line.
        stages: Heading of each cell of a contact.
        contacts: Contacts, the most interesting first.
    """
    shown = contacts[:MAX_CONTACTS]
    images = [[cell.image for cell in contact.cells if cell.image is not None] for contact in shown]
    width_px = max((_drawn_px(image)[0] for group in images for image in group), default=140 * SCALE)
    heights_px = [max((_drawn_px(image)[1] for image in group), default=80 * SCALE) for group in images]
    group_px = len(stages) * (width_px + GAP) - GAP + GROUP_GAP
    groups = min(CONTACTS_A_LINE, max(1, len(shown)))
    lines_px = [max(heights_px[i : i + groups]) for i in range(0, len(shown), groups)]
    more = f"and {len(contacts) - len(shown)} more in the folders beside this sheet" if contacts[MAX_CONTACTS:] else ""
    total_height = HEADER + sum(px + LABEL + CAPTION for px in lines_px) + MARGIN
    sheet = Image.new("RGB", (2 * MARGIN + groups * group_px - GROUP_GAP, total_height), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, 14), title, fill=INK, font=ImageFont.load_default(20))
    draw.text((MARGIN, 44), f"{subtitle}   {more}", fill=FAINT, font=ImageFont.load_default(15))
    for number, contact in enumerate(shown):
        line, group = divmod(number, groups)
        left = MARGIN + group * group_px
        top = HEADER + sum(px + LABEL + CAPTION for px in lines_px[:line])
        _draw_contact(sheet, (left, top), contact, (width_px, lines_px[line]))
        for stage, name in enumerate(stages if line == 0 else ()):
            draw.text((left + stage * (width_px + GAP), 76), name, fill=INK, font=ImageFont.load_default(15))
    sheet.save(path)


def _draw_contact(sheet: Image.Image, corner: tuple[int, int], contact: SheetContact, size_px: tuple[int, int]) -> None:
    draw = ImageDraw.Draw(sheet)
    left, below = corner[0], corner[1] + size_px[1]
    for stage, cell in enumerate(contact.cells):
        x = left + stage * (size_px[0] + GAP)
        _paste(sheet, (x, corner[1]), cell, size_px)
        draw.text((x, below + 4), cell.label, fill=INK, font=ImageFont.load_default(13))
    draw.text((left, below + LABEL), contact.title, fill=INK, font=ImageFont.load_default(14))
    draw.text((left, below + LABEL + 18), contact.detail, fill=FAINT, font=ImageFont.load_default(13))


def _paste(sheet: Image.Image, corner: tuple[int, int], cell: SheetCell, size_px: tuple[int, int]) -> None:
    if cell.image is None:
        draw = ImageDraw.Draw(sheet)
        far_corner = (corner[0] + size_px[0] - 1, corner[1] + size_px[1] - 1)
        draw.rectangle((*corner, *far_corner), outline=MISSING)
        draw.text((corner[0] + 12, corner[1] + 12), "nothing received", fill=MISSING, font=ImageFont.load_default(14))
        return
    colour = np.repeat(to_uint8(cell.image)[:, :, None], 3, axis=2)
    if cell.missing is not None and cell.missing.any():
        # Hatched: plain black could pass for a shadow.
        rows, columns = np.indices(cell.missing.shape)
        colour[cell.missing & ((rows + columns) % 8 == 0)] = MISSING
    sheet.paste(Image.fromarray(colour).resize(_drawn_px(cell.image), Image.Resampling.NEAREST), corner)


def _drawn_px(image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> tuple[int, int]:
    """Return width and height on the sheet."""
    scale = SCALE if max(image.shape) <= MAX_SCALED_PX else 1
    return image.shape[1] * scale, image.shape[0] * scale
