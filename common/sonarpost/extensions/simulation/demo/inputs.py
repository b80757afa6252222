"""Input of a demo: a simulated survey, survey files, or images of the user."""

import shutil
from pathlib import Path

from rich.console import Console

from sonarpost.codec.fitting import Fit, fit_image
from sonarpost.errors import BadInputError, SurveyFileError
from sonarpost.extensions.simulation.demo.settings import ChainSettings
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import SIDE_CAR_SUFFIX, list_images
from sonarpost.sonar.readers import recording_parts, supported_suffixes
from sonarpost.sonar.side_car import read_side_car
from sonarpost.sonar.survey import Survey


def simulated_survey(seed: int, console: Console) -> Survey:
    """Return a simulated survey; print what it holds."""
    with console.status("simulating a survey of 1000 pings"):
        simulated = simulate_survey(SurveySpec(seed=seed, seabed=SeabedKind.SAND, targets=6, clutter=6))
    mines = sum(truth.is_mine_like for truth in simulated.truth)
    console.print(
        f"simulated survey of {len(simulated.survey.pings)} pings over sand: "
        f"{mines} mine-like objects, {len(simulated.truth) - mines} others"
    )
    return simulated.survey


def survey_files(given: Path) -> tuple[Path, ...]:
    """Return a survey file, or those of a folder.

    Raises:
        SurveyFileError: There is no such file or folder, or no suitable file in it.
    """
    suffixes = supported_suffixes()
    if not given.exists():
        raise SurveyFileError(str(given), "", "no such file or folder", "a file or folder that exists")
    if not given.is_dir():
        if not given.name.lower().endswith(suffixes):
            raise SurveyFileError(str(given), "suffix", given.suffix, "one of " + ", ".join(suffixes))
        return (given,)
    found = tuple(sorted(p for p in given.iterdir() if p.name.lower().endswith(suffixes) and p.is_file()))
    if not found:
        raise SurveyFileError(str(given), "", "no such file in it", "files named *" + ", *".join(suffixes))
    return found


def usable_images(source: Path, fit: Fit, console: Console) -> tuple[Path, ...]:
    """Return the images that the vehicle can send; print conversions and unused files.

    Args:
        source: An image or a folder of images, each with a side-car or without.
        fit: What the vehicle does with an image outside 16..512 px a side.
        console: Output.

    Raises:
        BadInputError: There is no such file or folder, or no image that can be sent.
    """
    if not source.exists():
        raise SurveyFileError(str(source), "", "no such file or folder", "an image or a folder of images")
    found = list_images(source) if source.is_dir() else None
    lines = list(found.unused) if found else []
    usable: list[Path] = []
    errors: list[BadInputError] = []
    for path in found.images if found else (source,):
        try:
            image = read_any_image(path)
            notes = image.notes + fit_image(image.pixels, fit, str(path)).notes
            side_car = path.with_suffix(SIDE_CAR_SUFFIX)
            if side_car.is_file():
                notes += read_side_car(side_car, "check", "uuv-1").notes
            lines += [f"{path}: {note}" for note in notes]
            usable.append(path)
        except BadInputError as error:
            errors.append(error)
            lines.append(f"not used: {error}")
    if errors and not usable:
        raise errors[0]
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    return tuple(usable)


def deposit(paths: tuple[Path, ...], settings: ChainSettings, console: Console) -> None:
    """Copy files, with their side-cars or other parts, into the folder that the vehicle polls."""
    side_cars = 0
    for path in paths:
        others = [path.with_suffix(SIDE_CAR_SUFFIX)]
        if settings.mode == "survey":
            others = [part for part in recording_parts(path) if part != path and part.is_relative_to(path.parent)]
        present = [other for other in others if other.is_file()]
        side_cars += len(present)
        for other in present:
            target = settings.incoming / other.relative_to(path.parent)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(other, target)
        partial = settings.incoming / f".{path.name}"
        shutil.copyfile(path, partial)
        partial.rename(settings.incoming / path.name)
    if settings.mode == "snippets":
        console.print(f"{side_cars} of {len(paths)} images have a side-car with their position")
    console.print(f"{len(paths)} input file{'s' if len(paths) != 1 else ''}")
