"""The recipe of the codebooks shipped with the package.

A codebook holds pieces of the images it was built from, so what goes in must be free to pass on: the project's own
survey simulator, and the public-domain Humminbird recording that comes with the source distribution of PyHum 1.4.6 (US
Geological Survey). Nothing else. The simulated lines are made by the command `sonarpost codebook nominal`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sonarpost.cli.codebook.humminbird_lines import humminbird_lines
from sonarpost.codec.vq.builder import ProgressCallback, build
from sonarpost.codec.vq.codebook import Codebook
from sonarpost.codec.vq.patches import PatchPlan, cut_line, shuffled
from sonarpost.codec.vq.training_config import Round, TrainingImage, rms_distance

SOURCES = (
    "sonarpost's own survey simulator; "
    "Humminbird recording of the PyHum 1.4.6 source distribution (USGS, public domain)"
)


@dataclass(frozen=True)
class Recipe:
    """How a shipped codebook is made from training images.

    Attributes:
        tile_px: Side of a tile.
        max_tiles: Size of the codebook.
        rounds: Table IV's passes: first poorly rebuilt images and their most unusual tiles (targets, shadows, edges),
            then what comes until the codebook is full.
        passes: Passes of `refine` afterwards.
    """

    tile_px: int
    max_tiles: int
    rounds: tuple[Round, ...]
    passes: int


def _rounds(tile_px: int) -> tuple[Round, ...]:
    # The first round takes the unusual from everywhere (highlights, shadows, edges). An image of speckle is never
    # rebuilt with a figure of merit of 100, so the second takes in order what comes until the codebook is full:
    # measured, thresholds in between spend the places on rare grains and rebuild ordinary bottom worse.
    return (Round(39.0, rms_distance(56.0, tile_px), 500), Round(100.0, rms_distance(6.0, tile_px)))


RECIPES = (Recipe(10, 15_992, _rounds(10), 2), Recipe(20, 15_992, _rounds(20), 2))


def humminbird_images(folder: Path) -> list[TrainingImage]:
    """Cut the recording into training images (see `humminbird_lines` for the folder and the errors)."""
    plan = PatchPlan(copies=2)
    return [image for name, line in humminbird_lines(folder).items() for image in cut_line(name, line, plan)]


def build_nominal(
    recipe: Recipe,
    images: Sequence[TrainingImage],
    progress: ProgressCallback | None = None,
) -> Codebook:
    """Build one of the shipped codebooks; the same images, in any order, give the same bytes."""
    images = shuffled(images)
    tiles = build(
        images, recipe.tile_px, recipe.rounds, max_tiles=recipe.max_tiles, passes=recipe.passes, progress=progress
    )
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
    return Codebook(tiles, notes)
