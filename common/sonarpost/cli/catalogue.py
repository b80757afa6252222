"""`sonarpost catalogue`: build a tile catalogue, look into one, rebuild the shipped ones."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from rich.console import Console

from sonarpost.catalogue.build import MAX_TILES, Progress, Round, TrainingImage, build, rms_distance
from sonarpost.catalogue.nominal import RECIPES, Recipe, build_nominal, humminbird_images
from sonarpost.catalogue.refine import refine
from sonarpost.catalogue.store import Catalogue, load, open_catalogue, save
from sonarpost.catalogue.windows import Line, WindowPlan, cut_around, cut_line
from sonarpost.codec.interface import to_uint8
from sonarpost.codec.tiles import MAX_DIMS, Tiles
from sonarpost.codec.vq import catalogue_tag
from sonarpost.errors import CatalogueError, ConfigError, SurveyFileError
from sonarpost.sim.seabed import SeabedKind
from sonarpost.sim.survey import SurveySpec, simulate_survey
from sonarpost.sonar.image_files import read_image

IMAGE_SUFFIXES = (".tiff", ".tif", ".png")
DEFAULT_ROUNDS = "39:16"
_ROUND = re.compile(r"(?P<fom>\d{1,6}(\.\d{1,6})?):(?P<rms>\d{1,6}(\.\d{1,6})?)(:(?P<images>\d{1,9}))?", re.ASCII)
EXIT_SOME_FAILED = 1


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its three actions."""
    parser = subparsers.add_parser("catalogue", help="build and inspect tile catalogues")

    def show_help(_: argparse.Namespace) -> int:
        parser.print_help()
        return 0

    parser.set_defaults(run=show_help)
    actions = parser.add_subparsers(metavar="ACTION")
    _add_build(actions)
    info = actions.add_parser("info", help="show what a catalogue holds")
    info.add_argument("catalogue", metavar="NAME_OR_FILE", help="nominal-10, nominal-20 or a file")
    info.set_defaults(run=run_info)
    nominal = actions.add_parser("nominal", help="rebuild the shipped catalogues: same input, same bytes")
    nominal.add_argument(
        "--humminbird", type=Path, required=True, metavar="DIR", help="folder with the PyHum recording's channels"
    )
    nominal.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the catalogues")
    nominal.set_defaults(run=run_nominal)


def _add_build(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = actions.add_parser("build", help="build a catalogue from images (the paper's Table IV)")
    parser.add_argument(
        "--images", type=Path, nargs="+", required=True, metavar="DIR", help="folders of TIFF or PNG images, or files"
    )
    parser.add_argument("--tile", type=int, default=10, metavar="PX", help="side of a tile (default: 10)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the catalogue to write")
    parser.add_argument(
        "--rounds",
        default=DEFAULT_ROUNDS,
        metavar="FOM:RMS[:IMAGES],...",
        help="images below this figure of merit give tiles farther than this many grey levels RMS; "
        f"most images (default: {DEFAULT_ROUNDS}, the paper's 39 and 320 of 400-pixel tiles)",
    )
    parser.add_argument("--max-tiles", type=int, default=MAX_TILES, metavar="N", help=f"default: {MAX_TILES}")
    parser.add_argument(
        "--dims", type=int, default=MAX_DIMS, metavar="N", help=f"dimensions kept (default: {MAX_DIMS})"
    )
    parser.add_argument(
        "--refine", type=int, default=0, metavar="N", help="passes of refinement afterwards (default: 0)"
    )
    parser.add_argument("--core", metavar="NAME_OR_FILE", help="a catalogue to add to")
    parser.add_argument("--resume", action="store_true", help="go on with a build that was stopped")
    parser.set_defaults(run=run_build)


def run_build(args: argparse.Namespace) -> int:
    """Build; return 0, or 1 if an image had to be left out.

    Raises:
        SonarpostError: No image can be read, an argument is wrong, or the catalogue cannot be written.
    """
    rounds = parse_rounds(args.rounds, args.tile)
    journal = args.out.with_name(args.out.name + ".journal")
    if journal.exists() and not args.resume:
        raise CatalogueError(str(journal), "", "a build that was stopped", "--resume to go on, or remove the journal")
    console = Console(stderr=True)
    images, failed = _training_images(_image_paths(args.images), console)
    core = open_catalogue(args.core).tiles if args.core is not None else None
    database = build(
        images,
        args.tile,
        rounds,
        max_tiles=args.max_tiles,
        dims=args.dims,
        core=core,
        journal_path=journal,
        progress=_progress_to(console),
    )
    if args.refine:
        database = refine(
            database, images, args.refine, lambda n, rms: console.print(f"pass {n}: {rms:.2f} RMS before")
        )
    notes = {"images": str(len(images)), "rounds": args.rounds, "refine passes": str(args.refine)}
    if args.core is not None:
        notes["core"] = f"{args.core} {core.identity if core is not None else ''}"
    save(args.out, Catalogue(database, notes))
    journal.unlink()
    return run_info(argparse.Namespace(catalogue=str(args.out))) or (EXIT_SOME_FAILED if failed else 0)


def run_info(args: argparse.Namespace) -> int:
    """Print what a catalogue holds; return 0.

    Raises:
        CatalogueError: It cannot be read.
    """
    catalogue = open_catalogue(args.catalogue)
    tiles = catalogue.tiles
    facts = {
        "tiles": f"{len(tiles)} of {tiles.tile_px} x {tiles.tile_px} px",
        "dimensions": f"{tiles.dims} of {tiles.tile_px**2}",
        "identity": tiles.identity,
        "tag in streams": f"{catalogue_tag(tiles):#06x}",
        **catalogue.notes,
    }
    width = max(len(name) for name in facts)
    for name, value in facts.items():
        print(f"{name:{width}}  {value}")
    return 0


def run_nominal(args: argparse.Namespace) -> int:
    """Rebuild the shipped catalogues; return 0.

    Raises:
        SonarpostError: The recording cannot be read or a catalogue not be written.
    """
    console = Console(stderr=True)
    images = [*humminbird_images(args.humminbird), *_simulated_images(console)]
    console.print(f"{len(images)} training images")
    for recipe in RECIPES:
        _write_nominal(recipe, images, args.out, console)
    return 0


def _write_nominal(recipe: Recipe, images: list[TrainingImage], folder: Path, console: Console) -> None:
    path = folder / f"nominal-{recipe.tile_px}.tiles"
    save(path, build_nominal(recipe, images))
    tiles = load(path).tiles
    console.print(f"{path}: {len(tiles)} tiles, identity {tiles.identity}")


def parse_rounds(text: str, tile_px: int) -> tuple[Round, ...]:
    """Read `FOM:RMS[:IMAGES],...`.

    Raises:
        ConfigError: It is not of this form.
    """
    rounds = []
    for part in text.split(","):
        match = _ROUND.fullmatch(part.strip())
        if match is None:
            raise ConfigError("--rounds", "", part, "FOM:RMS or FOM:RMS:IMAGES, for example 39:16:500")
        most = int(match["images"]) if match["images"] else None
        rounds.append(Round(float(match["fom"]), rms_distance(float(match["rms"]), tile_px), most))
    return tuple(rounds)


def _image_paths(sources: list[Path]) -> list[Path]:
    """Return the images of all folders, sorted within each; the order decides what the catalogue becomes."""
    paths: list[Path] = []
    for source in sources:
        if source.is_dir():
            paths += sorted(p for p in source.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
        else:
            paths.append(source)
    return paths


def _training_images(paths: list[Path], console: Console) -> tuple[list[TrainingImage], int]:
    """Return the readable images (read when needed: a folder may hold more than memory) and how many are not."""
    images, failed = [], 0
    for path in paths:
        try:
            pixels = read_image(path)
        except SurveyFileError as error:
            failed += 1
            console.print(f"left out: {error}", markup=False)
            continue
        images.append(TrainingImage(f"{path} {pixels.shape} {pixels.dtype}", _loader(path)))
    return images, failed


def _loader(path: Path) -> Callable[[], Tiles]:
    return lambda: to_uint8(read_image(path))


def _progress_to(console: Console) -> Callable[[Progress], None]:
    def show(progress: Progress) -> None:
        merit = "first image" if math.isnan(progress.fom) else f"FOM {progress.fom:.1f}"
        console.print(
            f"round {progress.round_number + 1}: {progress.name}: {merit}, "
            f"{progress.added} tiles added, {progress.tiles} in all",
            markup=False,
            highlight=False,
        )

    return show


def _simulated_images(console: Console) -> Iterator[TrainingImage]:
    """Windows of simulated lines over every kind of bottom, and of the objects that lie there."""
    bottom = WindowPlan(reductions=SIMULATED_REDUCTIONS, per_reduction=16, least_std=4.0)
    objects = WindowPlan(reductions=SIMULATED_REDUCTIONS[:5], copies=2)
    for spec in SIMULATED_SURVEYS:
        simulated = simulate_survey(spec)
        name = simulated.survey.line_name
        console.print(f"{name}: simulated")
        for side in simulated.survey.sides():
            line: Line = simulated.survey.waterfall(side)
            yield from cut_line(f"{name} {side.value}", line, bottom)
            places = [(thing.ping, thing.sample_index) for thing in simulated.truth if thing.side is side]
            yield from cut_around(f"{name} {side.value}", line, places, objects)


# A simulated ping is 10 cm of track and a sample 3 cm of range: averaging three samples makes pixels square.
SIMULATED_REDUCTIONS = ((1, 1), (1, 2), (1, 3), (2, 3), (2, 6), (1, 4), (3, 6))
SIMULATED_SURVEYS = tuple(
    SurveySpec(seed=7000 + 10 * number + copy, seabed=kind, targets=12, clutter=12)
    for number, kind in enumerate(SeabedKind)
    for copy in range(2)
)
