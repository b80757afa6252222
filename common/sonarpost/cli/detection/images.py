"""`sonarpost detect --images DIR`: the confidence of every image of a folder, without navigation."""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import aligned, option, printable
from sonarpost.detection.images import ScaledImage, detect_in_image
from sonarpost.detection.settings import DetectorSettings
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import list_images

MIN_SIDE_PX: Final = 32
DEFAULT_PIXEL_M: Final = 0.05
PIXEL_RANGE_M: Final = (0.005, 1.0)
EXIT_SOME_INVALID: Final = 2
_SURVEY_OPTIONS: Final = ("plot", "snippets", "geotiff", "threshold", "max_contacts", "options", "crs")
"""Options of survey files that have no meaning for images."""


@dataclass(frozen=True, slots=True)
class ImageScore:
    """Score of one image: that of its most confident candidate, 0 without one.

    Attributes:
        path: The file.
        confidence: 0 to 2.
        p_mine_like: Probability of a mine-like object, 0 to 1.
        notes: What was converted to grey, see `read_any_image`.
    """

    path: Path
    confidence: float
    p_mine_like: float
    notes: tuple[str, ...] = ()


def add_image_options(parser: argparse.ArgumentParser) -> None:
    """Add --images and --pixel-m."""
    option(
        parser,
        "--images DIR",
        "score every JPEG, PNG and TIFF image of this folder instead of survey files; exit status 2 if any of "
        f"them cannot be read or has a side below {MIN_SIDE_PX} px",
        Path,
    )
    option(parser, "--pixel-m METRES", f"size of a pixel of the images of --images (default: {DEFAULT_PIXEL_M})", float)


def check_image_options(parsed: argparse.Namespace) -> None:
    """Check that either survey files or --images are given, and only options that belong to them.

    Raises:
        ConfigError: Both or none are given, an option of the other, or a pixel size out of range.
    """
    given = " ".join(map(str, parsed.files))
    if parsed.images is None:
        if not parsed.files:
            raise ConfigError("detect", "FILE", "nothing", "survey files, or --images DIR")
        if parsed.pixel_m is not None:
            raise ConfigError("detect", "--pixel-m", parsed.pixel_m, "this option with --images DIR only")
        return
    if parsed.files:
        raise ConfigError("detect", "FILE", given, f"either survey files or --images {parsed.images}, not both")
    for name in _SURVEY_OPTIONS:
        value = getattr(parsed, name)
        if value is not None and value is not False:
            option = "--" + name.replace("_", "-")
            raise ConfigError("detect", option, str(value), "this option with survey files only, not with --images")
    low_m, high_m = PIXEL_RANGE_M
    if parsed.pixel_m is not None and not low_m <= parsed.pixel_m <= high_m:
        raise ConfigError("detect", "--pixel-m", parsed.pixel_m, f"{low_m} to {high_m} m")


def run_images(folder: Path, pixel_m: float | None, settings: DetectorSettings, *, as_json: bool) -> int:
    """Score the images of a folder and print the scores.

    Args:
        folder: The folder; its subfolders are not searched.
        pixel_m: Size of a pixel, along-track and across-track; None for the default.
        settings: Settings of the detector; the threshold is not applied.
        as_json: Whether one line of JSON is printed in place of a table.

    Returns:
        0, or 2 if any image is invalid: it is reported on standard error, and the others are scored.

    Raises:
        SurveyFileError: The folder cannot be read or holds no images.
    """
    found = list_images(folder)
    for line in found.unused:
        print(printable(line), file=sys.stderr)
    scores: list[ImageScore] = []
    failed = 0
    with ProgressDisplay() as display:
        for number, path in enumerate(found.images):
            display.show("detecting in", number, len(found.images), printable(path.name))
            try:
                scores.append(score_image(path, DEFAULT_PIXEL_M if pixel_m is None else pixel_m, settings))
            except SurveyFileError as error:
                failed += 1
                print(f"sonarpost: {printable(str(error))}", file=sys.stderr)
    for note, count in sorted(Counter(note for score in scores for note in score.notes).items()):
        print(printable(f"note: {folder}: {count} images: {note}"), file=sys.stderr)
    if as_json:
        print(json.dumps({"images": [_as_json(score) for score in scores]}, allow_nan=False))
    else:
        _print_table(folder, scores)
    return EXIT_SOME_INVALID if failed else 0


def score_image(path: Path, pixel_m: float, settings: DetectorSettings) -> ImageScore:
    """Return the score of one image file.

    Raises:
        SurveyFileError: The file is not a readable image, or one of its sides is below 32 px.
    """
    image = read_any_image(path)
    rows, columns = image.pixels.shape
    if min(rows, columns) < MIN_SIDE_PX:
        raise SurveyFileError(str(path), "size", f"{columns} × {rows} px", f"at least {MIN_SIDE_PX} px a side")
    detection = detect_in_image(ScaledImage(image.pixels, pixel_m, pixel_m), settings)
    if detection is None:
        return ImageScore(path, 0.0, 0.0, image.notes)
    return ImageScore(path, detection.confidence, detection.p_mine_like, image.notes)


def _as_json(score: ImageScore) -> dict[str, object]:
    return {
        "file": str(score.path),
        "confidence": round(score.confidence, 6),
        "p_mine_like": round(score.p_mine_like, 6),
    }


def _print_table(folder: Path, scores: Sequence[ImageScore]) -> None:
    """Print the images, the most confident first."""
    print(printable(f"{folder}: {len(scores)} images"))
    ordered = sorted(scores, key=lambda s: -s.confidence)
    cells = [[f"{s.confidence:4.2f}", f"{s.p_mine_like:.3f}", printable(s.path.name)] for s in ordered]
    print("\n".join(aligned([["conf", "p_mine_like", "file"], *cells])))
