"""`sonarpost dataset export`: the contacts of a shore site with verdicts of operators, in COCO format."""

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Final

from sonarpost.archive.reader import as_folder
from sonarpost.cli.c2.stored import EXIT_INCOMPLETE, RecordFilter, add_filters, archive_of
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import flag, make_output_folder, option, print_rejected
from sonarpost.errors import BadInputError
from sonarpost.export.contacts import ExportContact, load_contacts
from sonarpost.extensions.dataset.coco import (
    ANNOTATIONS_FILE,
    IMAGES_FOLDER,
    LabelledImage,
    LabelState,
    coco_document,
    groups,
    label_state,
    load_labelled_image,
)
from sonarpost.files import write_atomically
from sonarpost.sonar.image_files import write_png

_COUNTED: Final[tuple[LabelState, ...]] = ("disputed", "unsure", "unreviewed", "without_image")


def add_actions(parser: CommandParser) -> None:
    """Add the command and its action."""
    export = parser.add_action(
        "export",
        "write images with verdicts in COCO format",
        run_export,
        "--archive demo-out/shore/images --out dataset",
        "Write every contact of a shore site that an operator has judged as mine-like or not: its image as "
        f"{IMAGES_FOLDER}/*.png, boxes and labels as {ANNOTATIONS_FILE}. Exit status 1: there is no such contact, and "
        "nothing is written, or a stored file was rejected.",
    )
    add_filters(export)
    option(export, "--out DIR", "folder of the data set", Path, required=True)
    flag(export, "--include-disputed", "also contacts about which operators disagree; the latest verdict is the label")
    flag(export, "--json", "print the counts as one JSON object")


def run_export(parsed: argparse.Namespace) -> int:
    """Write the data set; return 0, or 1 if there is no verdict or a stored file was rejected."""
    record_filter = RecordFilter.of(parsed)
    place = archive_of(parsed)
    with ProgressDisplay(step=f"reading {place}") as display, as_folder(place) as folder:
        stored = load_contacts(folder)
        contacts = [
            each
            for each in stored.contacts
            if record_filter.accepts(each.image.vessel_id, each.image.vehicle_id, each.image.first_frame_utc_s)
        ]
        states = Counter(label_state(each) for each in contacts)
        wanted = {"labelled", "disputed"} if parsed.include_disputed else {"labelled"}
        chosen = [each for each in contacts if label_state(each) in wanted]
        problems = list(stored.problems)
        images = _load(chosen, problems, display)
        if images:
            group_of = groups(stored.contacts)
            _write(parsed.out, images, json.dumps(coco_document(images, group_of, time.time()), allow_nan=False))
    counts: dict[str, int] = {"images": len(images)}
    counts |= {name: states[name] for name in _COUNTED} | {"rejected": len(problems)}
    _print_counts(parsed, counts, images)
    print_rejected(problems)
    if not images:
        reasons = ", ".join(f"{name.replace('_', ' ')} {states[name]}" for name in _COUNTED)
        print(
            f"sonarpost dataset: {place}: no contact with a usable verdict ({reasons}); nothing is written",
            file=sys.stderr,
        )
    return EXIT_INCOMPLETE if problems or not images else 0


def _load(chosen: list[ExportContact], problems: list[BadInputError], display: ProgressDisplay) -> list[LabelledImage]:
    """Read the images; add an error to `problems` for each that is rejected."""
    images = []
    for number, contact in enumerate(chosen):
        display.show("reading images", number, len(chosen))
        try:
            images.append(load_labelled_image(contact))
        except BadInputError as error:
            problems.append(error)
    return images


def _write(out: Path, images: list[LabelledImage], document: str) -> None:
    """Write the images, then the annotations: if these exist, the images are complete."""
    make_output_folder(out / IMAGES_FOLDER)
    for image in images:
        write_png(out / image.file_name, image.pixels)
    write_atomically(out / ANNOTATIONS_FILE, (document + "\n").encode())


def _print_counts(parsed: argparse.Namespace, counts: dict[str, int], images: list[LabelledImage]) -> None:
    mine_like = sum(image.decision.verdict == "mine_like" for image in images)
    if parsed.json:
        verdicts = {"mine_like": mine_like, "not_mine_like": len(images) - mine_like}
        print(json.dumps({"out": str(parsed.out) if images else None, **counts, **verdicts}))
    elif images:
        disputed = "included" if parsed.include_disputed else "excluded"
        print(
            f"{parsed.out}: {len(images)} images, {mine_like} mine-like; {counts['disputed']} disputed contacts "
            f"{disputed}, {counts['unsure']} unsure, {counts['without_image']} without an image"
        )
