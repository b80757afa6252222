"""Fit images of any size into the sides that the codecs accept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image

from sonarpost.codec.interface import MAX_SIDE_PX, MIN_SIDE_PX, SnippetPixels
from sonarpost.errors import StreamError

Fit = Literal["refuse", "crop", "resize"]
"""What to do with an image outside 16..512 px a side."""


@dataclass(frozen=True)
class FittedImage:
    """An image that a codec accepts.

    Attributes:
        pixels: Shape (16..512, 16..512), the type of the original.
        notes: Old and new size; empty if nothing was changed.
        scale_along: Rows of the original for each row; not 1 after a change of resolution only.
        scale_across: Columns of the original for each column.
    """

    pixels: SnippetPixels
    notes: tuple[str, ...] = ()
    scale_along: float = 1.0
    scale_across: float = 1.0


def fit_image(image: SnippetPixels, fit: Fit, where: str, option: str = "--fit {}") -> FittedImage:
    """Return an image with sides of 16..512 px; one that has them is returned unchanged.

    "crop" cuts the centre. "resize" keeps the aspect ratio: a larger image is reduced by averaging areas to a longer
    side of 512 px, a smaller one is enlarged linearly to a shorter side of 16 px.

    Args:
        image: Shape (rows, columns), at least 1 each, uint8 or uint16.
        fit: "refuse" raises an error for an image outside the limits.
        where: Name of the image in errors.
        option: How an error writes a choice; {} stands for "crop" or "resize".

    Raises:
        StreamError: The image is outside the limits and `fit` cannot change that.
    """
    rows, columns = image.shape
    if min(rows, columns) >= MIN_SIDE_PX and max(rows, columns) <= MAX_SIDE_PX:
        return FittedImage(image)
    limits = f"{MIN_SIDE_PX} to {MAX_SIDE_PX} px a side"
    size = f"{columns} × {rows} px"
    if fit == "refuse":
        choices = " or ".join(option.format(choice) for choice in ("crop", "resize"))
        raise StreamError(where, "size", size, f"{limits}; {choices} fits other images")
    if fit == "crop":
        height, width = min(rows, MAX_SIDE_PX), min(columns, MAX_SIDE_PX)
    else:
        factor = MAX_SIDE_PX / max(rows, columns)
        if max(rows, columns) <= MAX_SIDE_PX:
            factor = MIN_SIDE_PX / min(rows, columns)
        height, width = max(1, round(rows * factor)), max(1, round(columns * factor))
    if min(height, width) < MIN_SIDE_PX or max(height, width) > MAX_SIDE_PX:
        hint = f"; {option.format('resize')} enlarges small images" if fit == "crop" else ""
        raise StreamError(where, "size", f"{size}, after {fit} {width} × {height} px", limits + hint)
    if fit == "crop":
        top, left = (rows - height) // 2, (columns - width) // 2
        centre = image[top : top + height, left : left + width]
        return FittedImage(centre.copy(), (f"centre of {size} cropped to {width} × {height} px",))
    method = Image.Resampling.BOX if height < rows else Image.Resampling.BILINEAR
    resized = Image.fromarray(image.astype(np.float32)).resize((width, height), method)
    pixels: SnippetPixels = np.rint(np.asarray(resized)).astype(image.dtype)
    return FittedImage(pixels, (f"{size} resized to {width} × {height} px",), rows / height, columns / width)
