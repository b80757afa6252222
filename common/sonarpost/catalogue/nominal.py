"""The recipe of the catalogues shipped with the package.

A catalogue holds pieces of the images it was built from, so what goes in must be free to pass on: the public-domain
Humminbird recording that comes with the source distribution of PyHum 1.4.6 (US Geological Survey).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarpost.catalogue.build import Progress, Round, TrainingImage, build, rms_distance
from sonarpost.catalogue.refine import refine
from sonarpost.catalogue.store import Catalogue
from sonarpost.catalogue.windows import Line, WindowPlan, cut_line, shuffled
from sonarpost.errors import CatalogueError
from sonarpost.sonar.image_files import read_image

SOURCES = "Humminbird recording of the PyHum 1.4.6 source distribution (USGS, public domain)"
HUMMINBIRD_CHANNELS = ("B002", "B003")


def humminbird_lines(folder: Path) -> dict[str, Line]:
    """Read the recording's two side-scan channels.

    Args:
        folder: Holds the channels as grey images (row = ping, column = sample), one file with `B002` and one with
            `B003` in its name.

    Returns:
        Name to line, shape (pings, samples), float32, NaN in columns beyond the recorded range.

    Raises:
        CatalogueError: A channel is not there.
        SurveyFileError: An image cannot be read.
    """
    lines = {}
    for channel in HUMMINBIRD_CHANNELS:
        found = sorted(path for path in folder.glob(f"*{channel}*.png"))
        if len(found) != 1:
            names = [path.name for path in found]
            raise CatalogueError(str(folder), channel, names, f"one image with {channel} in its name")
        lines[f"humminbird {channel}"] = _without_padding(read_image(found[0]).astype(np.float32))
    return lines


def _without_padding(line: Line) -> Line:
    """Return the line with the zeros after the end of each ping as NaN."""
    padded = np.cumsum(line[:, ::-1] != 0, axis=1)[:, ::-1] == 0
    line[padded] = np.nan
    return line


@dataclass(frozen=True)
class Recipe:
    """How a shipped catalogue is made from training images.

    Attributes:
        tile_px: Side of a tile.
        max_tiles: Size of the catalogue.
        rounds: Table IV's passes: first poorly rebuilt images and their most unusual tiles (targets, shadows, edges),
            then finer and finer until the catalogue is full.
        passes: Passes of `refine` afterwards.
    """

    tile_px: int
    max_tiles: int
    rounds: tuple[Round, ...]
    passes: int


def _rounds(tile_px: int) -> tuple[Round, ...]:
    return (
        Round(39.0, rms_distance(48.0, tile_px), 400),
        Round(50.0, rms_distance(36.0, tile_px), 120),
        Round(60.0, rms_distance(24.0, tile_px), 120),
        Round(100.0, rms_distance(6.0, tile_px), None),
    )


RECIPES = (Recipe(10, 15_992, _rounds(10), 2), Recipe(20, 15_992, _rounds(20), 2))


def training_images(lines: dict[str, Line], plan: WindowPlan | None = None) -> list[TrainingImage]:
    """Cut lines into windows, in the order the shipped catalogues are built in."""
    chosen = plan or WindowPlan()
    return shuffled([image for name, line in lines.items() for image in cut_line(name, line, chosen)])


def build_nominal(
    recipe: Recipe,
    images: list[TrainingImage],
    progress: Callable[[Progress], None] | None = None,
) -> Catalogue:
    """Build one of the shipped catalogues; the same images give the same bytes."""
    grown = build(images, recipe.tile_px, recipe.rounds, max_tiles=recipe.max_tiles, progress=progress)
    tiles = refine(grown, images, recipe.passes)
    rounds = "; ".join(
        f"fom<{r.fom_below:g} distance>{r.distance_above:g} images<={r.max_images}" for r in recipe.rounds
    )
    notes = {
        "name": f"nominal-{recipe.tile_px}",
        "source": SOURCES,
        "images": str(len(images)),
        "rounds": rounds,
        "refine passes": str(recipe.passes),
    }
    return Catalogue(tiles, notes)
