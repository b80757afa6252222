"""Make a new classifier from verdicts of operators, and check it against the old one.

    sonarpost dataset export --out verdicts
    python -m research.detection.finetune --dataset verdicts --examples examples.npz --out new.npz

The training continues from the present classifier with the images of the data set and the examples of
`python -m research.training.detection.examples`, so that the new one does not forget them. A fifth of the groups of
the data set (survey lines) takes no part in it. The old and the new classifier are compared on these and on simulated
surveys. The result is a file with an identity; nothing installs it. To use it, copy it to the vehicle and set
`classifier` and `classifier_identity` in `[atd_stub.detector]`.

Requires PyTorch (CPU), which is not a dependency of the package.
"""

import argparse
import importlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from research.common.command import command_parser, run_command
from research.common.statistics import auc
from research.detection.simulated import evaluate_file, pd_at, roc
from research.training.detection.calibrate import with_calibration, write_classifier
from research.training.detection.examples import Examples
from sonarpost.detection.candidates import candidate_peaks
from sonarpost.detection.chips import ChipCutter
from sonarpost.detection.classifier import (
    MINE_LIKE_OBJECT,
    OTHER_OBJECT,
    Classifier,
    default_classifier,
    load_classifier,
)
from sonarpost.detection.images import ScaledImage, detect_in_image, normalise_window, seabed_window
from sonarpost.detection.matched_filter import matched_response
from sonarpost.detection.settings import DetectorSettings
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_files import read_image
from sonarpost.sonar.survey import Side

ANNOTATIONS_FILE: Final = "annotations.json"
STEPS: Final = 2000
LEARNING_RATE: Final = 3e-4
_SOURCE: Final = 1
"""Verdicts take the place of the tiles with targets among the sources of the training."""
_TEST_SHARE: Final = 0.2
_NEAR_CENTRE_M: Final = 1.5
_STRONG_SHARE: Final = 0.6
"""Weaker candidates beside the strongest one may be seabed."""
_MAX_BYTES: Final = 1 << 28
_SETTINGS: Final = DetectorSettings()
_GROUP_OFFSET: Final = 1_000_000


@dataclass(frozen=True)
class LabelledContact:
    """An image of the data set with its verdict.

    Attributes:
        image: The image; columns are slant range on both sides.
        label: Class of the classifier: mine-like or other object.
        group: Survey line.
    """

    image: ScaledImage
    label: int
    group: str


def load_dataset(folder: Path) -> list[LabelledContact]:
    """Read a data set of `sonarpost dataset export`. Images without a pixel size, and structures, are left out.

    Raises:
        ConfigError: `annotations.json` cannot be read or is invalid.
        SurveyFileError: An image cannot be read.
    """
    path = folder / ANNOTATIONS_FILE
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(str(path), "size", path.stat().st_size, f"at most {_MAX_BYTES} bytes")
        document = json.loads(path.read_text("utf-8"))
        images = {entry["id"]: entry for entry in document["images"]}
        return [
            contact
            for annotation in document["annotations"]
            if (contact := _labelled(folder, images[annotation["image_id"]], annotation)) is not None
        ]
    except OSError as error:
        raise ConfigError(str(path), "file", error.strerror or str(error), "a data set of dataset export") from error
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ConfigError(str(path), "content", repr(error), "a data set of dataset export") from error


def _labelled(folder: Path, entry: dict[str, Any], annotation: dict[str, Any]) -> LabelledContact | None:
    label = {1: MINE_LIKE_OBJECT, 2: OTHER_OBJECT}.get(annotation["category_id"])
    along_m, across_m = entry["pixel_along_m"], entry["pixel_across_m"]
    if label is None or not along_m or not across_m:
        return None
    name = Path(entry["file_name"])
    if name.is_absolute() or ".." in name.parts:
        raise ValueError(f"file_name {entry['file_name']!r} is outside the data set")
    image = ScaledImage(read_image(folder / name), float(along_m), float(across_m))
    return LabelledContact(image, label, str(entry["group"]))


def split_by_group(contacts: Sequence[LabelledContact]) -> tuple[list[LabelledContact], list[LabelledContact]]:
    """Return contacts for training and for the test: every fifth group, by name, is for the test.

    Raises:
        ConfigError: There are fewer than two groups.
    """
    groups = sorted({contact.group for contact in contacts})
    if len(groups) < 2:
        raise ConfigError("finetune", "groups", len(groups), "contacts of at least 2 survey lines")
    test = set(groups[:: round(1 / _TEST_SHARE)])
    return [c for c in contacts if c.group not in test], [c for c in contacts if c.group in test]


def contact_examples(contacts: Sequence[LabelledContact]) -> Examples:
    """Return the strong candidates within 1.5 m of each centre as examples with the label of the verdict.

    Raises:
        ConfigError: No image has such a candidate.
    """
    parts = []
    groups = sorted({contact.group for contact in contacts})
    for contact in contacts:
        window = seabed_window(contact.image)
        grid = None if window is None else normalise_window(window, Side.STARBOARD)
        if window is None or grid is None:
            continue
        rows, columns = contact.image.pixels.shape
        row = (rows / 2 - window.top) * contact.image.pixel_along_m / grid.row_along_m
        cell = (columns / 2 - window.left) * contact.image.pixel_across_m / grid.cell_across_m
        near = [
            peak
            for peak in candidate_peaks(matched_response(grid, _SETTINGS), grid, _SETTINGS)
            if abs(peak.row - row) * grid.row_along_m < _NEAR_CENTRE_M
            and abs(peak.cell - cell) * grid.cell_across_m < _NEAR_CENTRE_M
        ]
        near = [peak for peak in near if peak.score >= _STRONG_SHARE * near[0].score]
        if near:
            labels = np.full(len(near), contact.label, dtype=np.int8)
            group = _GROUP_OFFSET + groups.index(contact.group)
            parts.append(Examples.of_chips(ChipCutter(grid).chips(near), labels, _SOURCE, group))
    if not parts:
        raise ConfigError("finetune", "dataset", "no candidate", "images with a highlight and a shadow at the centre")
    return Examples.joined(parts)


def scores(contacts: Sequence[LabelledContact], settings: DetectorSettings) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the greatest confidence in each image, shape (contacts,)."""
    found = (detect_in_image(contact.image, settings, Side.STARBOARD) for contact in contacts)
    return np.array([0.0 if each is None else each.confidence for each in found])


@dataclass(frozen=True)
class Comparison:
    """Figures of one classifier.

    Attributes:
        auc: Area under the ROC curve on the test contacts, mine-like against others; None with one class only.
        pd_at_one_false_alarm: Probability of detection in simulated surveys at one false alarm a file, by seabed.
    """

    auc: float | None
    pd_at_one_false_alarm: dict[str, float]


def compared(path: Path, test: Sequence[LabelledContact], files: int) -> Comparison:
    """Measure the classifier of a file on the test contacts and on `files` simulated surveys of each seabed."""
    settings = DetectorSettings(classifier=str(path.absolute()))
    is_mine = np.array([contact.label == MINE_LIKE_OBJECT for contact in test], dtype=np.bool_)
    area = float(auc(scores(test, settings), is_mine)[0]) if is_mine.any() and not is_mine.all() else None
    pd = {}
    for kind in SeabedKind:
        evaluated = [evaluate_file(kind, 22_000 + n, settings) for n in range(files)]
        if evaluated:
            pd[kind.value] = round(pd_at(roc(evaluated), 1.0), 3)
    return Comparison(None if area is None else round(area, 3), pd)


def new_classifier(start: Classifier, examples: Examples, steps: int, seed: int) -> Classifier:
    """Train from a classifier; the calibration stays that of the start.

    Raises:
        ConfigError: PyTorch is not installed.
    """
    try:
        module = importlib.import_module("research.training.detection.train")
    except ModuleNotFoundError as error:
        raise ConfigError("finetune", "PyTorch", str(error), "the package torch") from error
    trained: Classifier = module.train(examples, steps, seed, start, LEARNING_RATE)
    slope, *offsets = start.weights["calibration"].tolist()
    return with_calibration(trained, slope, (offsets[0], offsets[1], offsets[2]))


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "detection.finetune",
        description="Train a new classifier from verdicts of operators, write it to a file, and compare it with the "
        "present one on survey lines that took no part and on simulated surveys. Nothing installs the result.",
    )
    parser.add_argument("--dataset", type=Path, required=True, metavar="DIR", help="result of sonarpost dataset export")
    parser.add_argument("--examples", type=Path, metavar="FILE.npz", help="examples of the present classifier")
    parser.add_argument("--start", type=Path, metavar="FILE.npz", help="present classifier (default: the shipped one)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz", help="new classifier")
    parser.add_argument("--steps", type=int, default=STEPS, help="training steps (default: %(default)s)")
    parser.add_argument("--files", type=int, default=2, help="simulated surveys of each seabed (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Train, write the new classifier, and print the comparison; return 0.

    Raises:
        ConfigError: The data set or a classifier is invalid.
        SurveyFileError: An image cannot be read.
    """
    start = default_classifier() if arguments.start is None else load_classifier(arguments.start)
    train_part, test_part = split_by_group(load_dataset(arguments.dataset))
    examples = contact_examples(train_part)
    print(f"{len(train_part)} contacts for training, {len(test_part)} for the test", flush=True)
    if arguments.examples is not None:
        examples = Examples.joined([Examples.load(arguments.examples), examples])
    result = new_classifier(start, examples, arguments.steps, arguments.seed)
    old_path = arguments.out.with_suffix(".old.npz")
    for path, classifier in ((old_path, start), (arguments.out, result)):
        write_classifier(classifier, path)
    for name, path in (("present", old_path), ("new", arguments.out)):
        figures = compared(path, test_part, arguments.files)
        identity = load_classifier(path).identity
        print(json.dumps({"classifier": name, "identity": identity, **asdict(figures)}))
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
