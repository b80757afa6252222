"""`python -m research.prepare_data DIR`: check recordings and make the files that research derives from them.

From the masks of SDVD it makes `snippets/sdvd/index.csv` with the box of each target, and from each recording a PNG for
each side in `surveys/derived` (row = ping, column = sample, port farthest first). The same recordings give the same
files. README.md#data states where to get the recordings.
"""

import argparse
import csv
import hashlib
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from research.codebook.shipped import read_channel
from research.common.command import command_parser, report_progress, run_command
from research.common.images import SDVD_FIELDS, missing_data
from sonarpost.files import write_atomically
from sonarpost.sonar.image_decoding import GreyImage, read_any_image
from sonarpost.sonar.image_files import list_images, write_png
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side

SHA256: Final = {
    "surveys/scotsman-iver2.xtf": "32965ca6676a56cd4adf94ea323ef981d2ba90a0a92b30c495a390afd05d3384",
    "surveys/000_1236.xtf": "3743f04e3c1f46ee3142b9f61b43e3836fe1d53855a6bd36a4f0c964e9736013",
    "surveys/humminbird/test/B002.SON": "f1ff16b685635b2402a3b0662b92a2b8ec2faea0ac5fd02bee65afa0c25c9f3b",
    "surveys/humminbird/test/B003.SON": "df0d07447867fc08b8a1c80233223606a5a976586246ef7d1344b8a7ae903a5d",
}
_MASK_LEVEL: Final = 127
_SHORT: Final = {Side.PORT: "port", Side.STARBOARD: "stbd"}


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser("prepare_data", "Check recordings and make the files that research derives from them.")
    parser.add_argument("data", type=Path, metavar="DIR", help="folder with the layout of research/README.md#data")
    return parser


def run(args: argparse.Namespace) -> int:
    """Check and make everything that is there; return 0.

    Raises:
        SonarpostError: The folder has none of the recordings, or one cannot be read.
        OSError: A file cannot be written.
    """
    root: Path = args.data
    present = [name for name in SHA256 if (root / name).is_file()]
    for name in sorted(SHA256):
        state = _state(root / name, SHA256[name]) if name in present else "absent"
        print(f"{name}: {state}")
    sdvd = root / "snippets" / "sdvd"
    if not present and not sdvd.is_dir():
        raise missing_data(root, "none of the recordings")
    derived = root / "surveys" / "derived"
    derived.mkdir(parents=True, exist_ok=True)
    for name in present:
        report_progress(f"reading {name}")
        _derive(root / name, derived)
    if sdvd.is_dir():
        count = write_sdvd_index(sdvd)
        print(f"{sdvd / 'index.csv'}: {count} tiles")
    return 0


def _state(path: Path, expected: str) -> str:
    with path.open("rb") as file:
        return "as published" if hashlib.file_digest(file, "sha256").hexdigest() == expected else "another content"


def _derive(path: Path, folder: Path) -> None:
    """Write a recording as PNG, one a side, in its own depth."""
    if path.suffix == ".SON":
        side = {"B002": "port", "B003": "stbd"}[path.stem]
        write_png(folder / f"pyhum_{path.stem}_{side}.png", read_channel(path))
        return
    survey = read_survey(path)
    dtype = survey.pings[0].channels[0].samples.dtype
    for side in survey.sides():
        waterfall = np.nan_to_num(survey.waterfall(side))
        pixels: GreyImage = waterfall.astype(np.uint8) if dtype.itemsize == 1 else waterfall.astype(np.uint16)
        write_png(folder / f"{path.name}.{_SHORT[side]}.png", pixels[:, ::-1] if side is Side.PORT else pixels)


def write_sdvd_index(folder: Path) -> int:
    """Write `index.csv` of SDVD from its masks; return the number of tiles.

    Args:
        folder: Contains `train` and `test`, each with `images` and `masks` of equal names.

    Raises:
        SurveyFileError: An image has no mask, or a file cannot be read.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(SDVD_FIELDS)
    count = 0
    for split in ("train", "test"):
        masks = {path.stem: path for path in list_images(folder / split / "masks").images}
        for image in list_images(folder / split / "images").images:
            if image.stem not in masks:
                raise missing_data(folder / split / "masks" / image.name, "no mask")
            rows, columns = np.nonzero(read_any_image(masks[image.stem]).pixels > _MASK_LEVEL)
            box = [columns.min(), rows.min(), columns.max(), rows.max()] if rows.size else [""] * 4
            height_px, width_px = read_any_image(image).pixels.shape
            writer.writerow([split, image.name, width_px, height_px, rows.size, *box])
            count += 1
    write_atomically(folder / "index.csv", text.getvalue().encode())
    return count


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
