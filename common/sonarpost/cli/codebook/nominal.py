"""`sonarpost codebook nominal`: rebuild the shipped codebooks."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from sonarpost.cli.codebook.default_codebooks import RECIPES, Recipe, build_nominal, humminbird_images
from sonarpost.cli.codebook.progress import ProgressDisplay
from sonarpost.codec.vq.codebook import load, save
from sonarpost.codec.vq.patches import PatchPlan, SonarLine, cut_around, cut_line
from sonarpost.codec.vq.training_config import TrainingImage
from sonarpost.errors import ConfigError
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind

# A simulated ping is 10 cm of track and a sample 3 cm of range: averaging three samples makes pixels square.
SIMULATED_REDUCTIONS = ((1, 1), (1, 2), (1, 3), (2, 3), (2, 6), (1, 4), (3, 6))
SIMULATED_SURVEYS = tuple(
    SurveySpec(seed=7000 + 10 * number + copy, seabed=kind, targets=12, clutter=12)
    for number, kind in enumerate(SeabedKind)
    for copy in range(2)
)


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("nominal", help="rebuild the shipped codebooks: same input, same bytes")
    parser.add_argument(
        "--humminbird", type=Path, required=True, metavar="DIR", help="folder with the PyHum recording's channels"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the codebooks, made where absent"
    )
    parser.add_argument(
        "--refine", type=int, metavar="N", help="passes of refinement, other than the recipe's 2; 0: Table IV alone"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Rebuild the shipped codebooks; return 0.

    Raises:
        SonarpostError: The recording cannot be read or a codebook not be written.
    """
    if args.refine is not None and args.refine < 0:
        raise ConfigError("--refine", "", args.refine, "zero or more passes")
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("--out", "", f"{args.out} ({error.strerror})", "a folder, or a place for one") from error
    recipes = RECIPES if args.refine is None else tuple(replace(r, passes=args.refine) for r in RECIPES)
    console = Console(stderr=True)
    images = [*humminbird_images(args.humminbird), *simulated_images(console)]
    console.print(f"{len(images)} training images")
    for recipe in recipes:
        _write(recipe, images, args.out, console)
    return 0


def simulated_images(console: Console) -> Iterator[TrainingImage]:
    """Yield windows of simulated lines over every kind of bottom, and of the objects that lie there."""
    bottom = PatchPlan(reductions=SIMULATED_REDUCTIONS, per_reduction=16, least_std=4.0)
    objects = PatchPlan(reductions=SIMULATED_REDUCTIONS[:5], copies=2)
    for spec in SIMULATED_SURVEYS:
        simulated = simulate_survey(spec)
        name = simulated.survey.line_name
        console.print(f"{name}: simulated")
        for side in simulated.survey.sides():
            line: SonarLine = simulated.survey.waterfall(side)
            yield from cut_line(f"{name} {side.value}", line, bottom)
            places = [(thing.ping, thing.sample_index) for thing in simulated.truth if thing.side is side]
            yield from cut_around(f"{name} {side.value}", line, places, objects)


def _write(recipe: Recipe, images: list[TrainingImage], folder: Path, console: Console) -> None:
    path = folder / f"nominal-{recipe.tile_px}.tiles"
    with ProgressDisplay(console) as display:
        save(path, build_nominal(recipe, images, display.build))
    tiles = load(path).tiles
    console.print(f"{path}: {len(tiles)} tiles, identity {tiles.identity}")
