"""The contact sheet of the demo."""

import numpy as np
from PIL import Image

from sonarpost.extensions.simulation.demo.report import MARGIN, SheetCell, SheetContact, write_sheet


def test_small_images_are_drawn_twice_as_large_and_large_ones_as_they_are(tmp_path):
    small, large = np.full((80, 140), 255, np.uint8), np.full((300, 512), 255, np.uint8)
    contacts = [SheetContact("a", "", (SheetCell("s", small),)), SheetContact("b", "", (SheetCell("l", large),))]
    write_sheet(tmp_path / "sheet.png", "title", "subtitle", ("original",), contacts)
    with Image.open(tmp_path / "sheet.png") as sheet:
        white = np.asarray(sheet.convert("L")) == 255
    columns = np.flatnonzero(white.sum(axis=0) >= 80)
    assert columns[0] == MARGIN
    assert len(columns) == 2 * 140 + 512
    assert white.sum() == 4 * small.size + large.size
