"""`python -m research.codebook.shipped`: builds the shipped codebooks; the same input gives the same bytes.

A codebook contains parts of the images it was built from, so its sources must be free to redistribute: the survey
simulator of the project, and the public-domain Humminbird recording of the PyHum 1.4.6 source distribution (US
Geological Survey).

Layout of a Humminbird channel, checked ping by ping in that recording: `B002.IDX` contains (time, offset) pairs, u32
big endian, one a ping. At each offset of `B002.SON` a header of 67 bytes begins with C0 DE AB 21 and ends with the tag
A0, the number of samples (u32, big endian) and the byte 21. The samples follow, one byte each, nearest first. B002 is
port, B003 is starboard.
"""

import argparse
import struct
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console

from research.codebook.builder import ProgressCallback, Round, TrainingImage, build, rms_distance
from research.codebook.codebook_file import save
from research.common.command import command_parser, run_command
from research.common.patches import PatchPlan, SonarLine, cut_around, cut_line, shuffled
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.codec.vq.codebook import Codebook, load
from sonarpost.errors import CodebookError, ConfigError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_files import read_image

SOURCES = (
    "sonarpost's own survey simulator; "
    "Humminbird recording of the PyHum 1.4.6 source distribution (USGS, public domain)"
)


@dataclass(frozen=True)
class Recipe:
    """Parameters of a shipped codebook.

    Attributes:
        tile_px: Side of a tile.
        max_tiles: Size of the codebook.
        rounds: Rounds of Table IV: first poorly coded images and their most unusual tiles (targets, shadows, edges),
            then further tiles until the codebook is full.
        passes: Passes of refinement afterwards.
    """

    tile_px: int
    max_tiles: int
    rounds: tuple[Round, ...]
    passes: int


def _rounds(tile_px: int) -> tuple[Round, ...]:
    # The first round adds unusual tiles of all images (highlights, shadows, edges). A figure of merit of 100 is never
    # reached for speckle, so the second round adds tiles in order until the codebook is full. Thresholds in between
    # were measured: they add rare speckle and code ordinary seabed worse.
    return (Round(39.0, rms_distance(56.0, tile_px), 500), Round(100.0, rms_distance(6.0, tile_px)))


RECIPES = (Recipe(10, 15_992, _rounds(10), 2), Recipe(20, 15_992, _rounds(20), 2))


def humminbird_images(folder: Path) -> list[TrainingImage]:
    """Cut the recording into training images; folder and errors as for `humminbird_lines`."""
    plan = PatchPlan(copies=2)
    return [image for name, line in humminbird_lines(folder).items() for image in cut_line(name, line, plan)]


def build_nominal(
    recipe: Recipe,
    images: Sequence[TrainingImage],
    progress: ProgressCallback | None = None,
) -> Codebook:
    """Build one of the shipped codebooks; the same images in any order give the same bytes."""
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


CHANNELS = ("B002", "B003")

_START = b"\xc0\xde\xab\x21"
_HEADER_BYTES = 67
_COUNT = struct.Struct(">BIB")  # the last six bytes of the header
_MAX_SAMPLES = 1 << 16


def humminbird_lines(folder: Path) -> dict[str, SonarLine]:
    """Read both channels, from the recording or from images of it.

    Args:
        folder: Contains, directly or in a subfolder, `B002.SON` and `B002.IDX`, or one grey PNG with `B002` in its
            name (row = ping, column = sample); the same for `B003`.

    Returns:
        Name to line, shape (pings, samples), float32; NaN beyond the end of a ping. The recording and an image of it
        give the same lines.

    Raises:
        CodebookError: A channel is missing, or the recording is damaged.
        SurveyFileError: An image cannot be read.
    """
    return {f"humminbird {channel}": _without_padding(_channel(folder, channel)) for channel in CHANNELS}


def read_channel(son: Path) -> npt.NDArray[np.uint8]:
    """Read one channel of a recording.

    Args:
        son: The `.SON` file, with its `.IDX` file beside it.

    Returns:
        Shape (pings, samples of the longest), uint8, zeros after the end of a shorter ping.

    Raises:
        CodebookError: A file cannot be read or is damaged; the message contains the number of the ping.
    """
    data, index = _read(son), _read(son.with_suffix(".IDX"))
    if len(index) % 8 or not index:
        raise CodebookError(str(son.with_suffix(".IDX")), "length", f"{len(index)} B", "8 B for each ping")
    offsets = np.frombuffer(index, dtype=">u4")[1::2].tolist()
    pings = [_ping(data, offset, f"{son} ping {number}") for number, offset in enumerate(offsets)]
    image = np.zeros((len(pings), max(ping.size for ping in pings)), dtype=np.uint8)
    for row, ping in zip(image, pings, strict=True):
        row[: ping.size] = ping
    return image


def _ping(data: bytes, offset: int, where: str) -> npt.NDArray[np.uint8]:
    header = data[offset : offset + _HEADER_BYTES]
    if len(header) < _HEADER_BYTES or not header.startswith(_START):
        raise CodebookError(where, "header", header[:8], f"{_HEADER_BYTES} B that begin with C0 DE AB 21")
    tag, count, end = _COUNT.unpack(header[-_COUNT.size :])
    if (tag, end) != (0xA0, 0x21):
        raise CodebookError(where, "header", header[-_COUNT.size :], "A0, the number of samples, 21 at its end")
    first = offset + _HEADER_BYTES
    if not 1 <= count <= min(_MAX_SAMPLES, len(data) - first):
        raise CodebookError(where, "samples", count, f"1..{_MAX_SAMPLES}, no more than the file holds")
    return np.frombuffer(data, np.uint8, count, first)


def _channel(folder: Path, channel: str) -> npt.NDArray[np.generic]:
    recordings = sorted(folder.rglob(f"{channel}.SON"))
    if len(recordings) == 1:
        return read_channel(recordings[0])
    images = sorted(folder.glob(f"*{channel}*.png"))
    if recordings or len(images) != 1:
        found = [path.name for path in (*recordings, *images)]
        raise CodebookError(
            str(folder),
            channel,
            found,
            f"one {channel}.SON, or one PNG with {channel} in its name (research/README.md#data)",
        )
    return read_image(images[0])


def _without_padding(image: npt.NDArray[np.generic]) -> SonarLine:
    """Return the line with the zeros after the end of each ping as NaN."""
    line = image.astype(np.float32)
    line[np.cumsum(line[:, ::-1] != 0, axis=1)[:, ::-1] == 0] = np.nan
    return line


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CodebookError(str(path), "", error.strerror or str(error), "a file of the recording") from error


# Simulated pings are 10 cm apart and samples 3 cm: the mean of three samples gives square pixels.
SIMULATED_REDUCTIONS = ((1, 1), (1, 2), (1, 3), (2, 3), (2, 6), (1, 4), (3, 6))
SIMULATED_SURVEYS = tuple(
    SurveySpec(seed=7000 + 10 * number + copy, seabed=kind, targets=12, clutter=12)
    for number, kind in enumerate(SeabedKind)
    for copy in range(2)
)


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser("codebook.shipped", "Build the shipped codebooks; the same input gives the same bytes.")
    parser.add_argument(
        "--humminbird", type=Path, required=True, metavar="DIR", help="folder with the channels of the PyHum recording"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder, created if missing")
    parser.add_argument("--refine", type=int, metavar="N", help="passes of refinement (default: 2); 0: Table IV alone")
    return parser


def run(args: argparse.Namespace) -> int:
    """Build the shipped codebooks; return 0.

    Raises:
        SonarpostError: The recording cannot be read, or a codebook cannot be written.
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
    """Yield windows of simulated lines over every kind of seabed, and windows of their objects."""
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
        save(path, build_nominal(recipe, images, lambda progress: progress.show_on(display)))
    tiles = load(path).tiles
    console.print(f"{path}: {len(tiles)} tiles, identity {tiles.identity}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
