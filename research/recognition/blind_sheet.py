"""`python -m research.recognition.blind_sheet`: a sheet of unlabelled images for judgement by a person.

    python -m research.recognition.blind_sheet --sdvd DIR --codec emb --budget 64 --out sheet.png
    python -m research.recognition.blind_sheet --sdvd DIR --judgements judgements.json

The person gives each image a number from 0 (certainly no target) to 10 (certainly a target). Half of the images have a
target. The crops and their order depend on the seed only, not on codec and budget.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from research.common.command import add_strength_argument, command_parser, run_command
from research.common.images import SampleImage, sdvd_crops
from research.common.measurement import create_codec
from research.common.plots import SheetCell, write_sheet
from research.common.statistics import auc
from sonarpost.errors import ConfigError

COUNT: Final = 40
COLUMNS: Final = 8
LIMIT: Final = 10
"""Largest judgement."""
ORIGINAL: Final = "original"


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "recognition.blind_sheet",
        description="Write a numbered sheet of decoded crops of SDVD's test split, half with a target, or evaluate "
        "judgements of such a sheet.",
    )
    parser.add_argument("--sdvd", type=Path, required=True, metavar="DIR", help="folder of the SDVD data set")
    parser.add_argument("--codec", default="emb", help=f"codec, or {ORIGINAL} (default: %(default)s)")
    parser.add_argument("--budget", type=int, default=64, metavar="B", help="bytes of a stream (default: %(default)s)")
    add_strength_argument(parser)
    parser.add_argument("--seed", type=int, default=0, help="order and choice of the crops (default: %(default)s)")
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--out", type=Path, metavar="FILE.png", help="write the sheet")
    action.add_argument(
        "--judgements",
        type=Path,
        metavar="FILE.json",
        help=f'evaluate {{"SHEET": [{COUNT} numbers 0..{LIMIT}], …}}; "{ORIGINAL}" is compared with the others',
    )
    return parser


def chosen_crops(crops: Sequence[SampleImage], seed: int) -> list[SampleImage]:
    """Return the crops of a sheet in its order, half of them with a target.

    Raises:
        ConfigError: There are too few crops of either kind.
    """
    rng = np.random.default_rng(seed)
    chosen: list[SampleImage] = []
    for has_target in (False, True):
        found = [crop for crop in crops if crop.is_target is has_target]
        if len(found) < COUNT // 2:
            raise ConfigError("research", "--sdvd", f"{len(found)} crops", f"at least {COUNT // 2} of each kind")
        chosen += [found[i] for i in rng.choice(len(found), COUNT // 2, replace=False)]
    return [chosen[i] for i in rng.permutation(COUNT)]


def read_judgements(path: Path) -> dict[str, list[float]]:
    """Return the numbers of each sheet.

    Raises:
        ConfigError: The file is not a JSON object of lists of `COUNT` numbers from 0 to `LIMIT`.
    """
    expected = f"{COUNT} numbers 0..{LIMIT}"
    try:
        sheets = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(str(path), "JSON", str(error), f'{{"SHEET": [{expected}]}}') from error
    if not isinstance(sheets, dict):
        raise ConfigError(str(path), "JSON", type(sheets).__name__, f'{{"SHEET": [{expected}]}}')
    for name, numbers in sheets.items():
        if not isinstance(numbers, list) or len(numbers) != COUNT:
            raise ConfigError(str(path), name, numbers, expected)
        if not all(isinstance(number, int | float) and 0 <= number <= LIMIT for number in numbers):
            raise ConfigError(str(path), name, numbers, expected)
    return sheets


def evaluate(judgements: dict[str, list[float]], has_target: Sequence[bool]) -> list[tuple[str, float, int | None]]:
    """Return for each sheet its name, the area under the ROC curve and the agreement with the sheet of the originals.

    Two judgements of an image agree if both are above half of `LIMIT` or both are not; None without that sheet.
    """
    rows = []
    reference = judgements.get(ORIGINAL)
    for name, numbers in judgements.items():
        area = float(auc(np.array(numbers, float), np.array(has_target))[0])
        agreed = None
        if reference is not None:
            pairs = zip(numbers, reference, strict=True)
            agreed = sum((a > LIMIT / 2) == (b > LIMIT / 2) for a, b in pairs)
        rows.append((name, area, agreed))
    return rows


def run(args: argparse.Namespace) -> int:
    """Write the sheet, or print the evaluation.

    Raises:
        SonarpostError: Invalid options, data set or judgements.
    """
    crops = chosen_crops(sdvd_crops(args.sdvd).images, args.seed)
    if args.judgements is not None:
        for name, area, agreed in evaluate(read_judgements(args.judgements), [bool(crop.is_target) for crop in crops]):
            print(f"{name}: area {area:.3f}" + ("" if agreed is None else f", agreement {agreed} of {COUNT}"))
        return 0
    images = [crop.pixels for crop in crops]
    if args.codec != ORIGINAL:
        codec = create_codec(args.codec, strength=args.strength)
        images = [codec.decode(codec.encode(image, args.budget)).image for image in images]
    cells = [SheetCell(image, str(number)) for number, image in enumerate(images, start=1)]
    rows = [cells[i : i + COLUMNS] for i in range(0, COUNT, COLUMNS)]
    write_sheet(args.out, f"{COUNT} crops, half of them with a target", rows, scale=2, is_grey=True)
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
