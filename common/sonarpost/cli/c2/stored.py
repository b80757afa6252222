"""`sonarpost c2 ls`, `get` and `export`: list, copy and export the records in the archive of c2."""

import argparse
import json
import math
import os
import re
import sys
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sonarpost.archive.reader import ArchivePlace, as_folder, open_reader, place_of, read_image_files
from sonarpost.archive.rows import DecisionRow, ImageRow, TaskingRow, document_of
from sonarpost.archive.shore_files import find_image
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import flag, in_new_folder, make_output_folder, option, print_rejected, printable, time_text
from sonarpost.config import load
from sonarpost.errors import BadInputError, ConfigError, DeliveryError
from sonarpost.export.contacts import ContactSet, ExportContact, load_contacts, match_start_time
from sonarpost.export.formats import exporters, write_export
from sonarpost.export.text import probabilities_text
from sonarpost.files import write_atomically
from sonarpost.messages import Contact
from sonarpost.services.c2.config import C2Config

DEMO_IMAGES = Path("demo-out/shore/images")
SHORE_CONFIG = Path("/etc/sonarpost/shore.toml")
PIPED_WIDTH = 160
EXIT_INCOMPLETE = 1

_AGO = re.compile(r"(\d+(?:\.\d+)?)([smhd])")
_UNIT_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


@dataclass(frozen=True, slots=True)
class RecordFilter:
    """Values of --vessel, --vehicle, --since and --until; None for all."""

    vessel: str | None = None
    vehicle: str | None = None
    since_utc_s: float = 0.0
    until_utc_s: float = math.inf

    @classmethod
    def of(cls, parsed: argparse.Namespace) -> "RecordFilter":
        """Return the filter of a command line.

        Raises:
            ConfigError: `--since` or `--until` is invalid.
        """
        since_utc_s = 0.0 if parsed.since is None else time_of("--since", parsed.since)
        until_utc_s = math.inf if parsed.until is None else time_of("--until", parsed.until)
        return cls(parsed.vessel, parsed.vehicle, since_utc_s, until_utc_s)

    def accepts(self, vessel_id: str, vehicle_id: str, time_utc_s: float) -> bool:
        """Return whether a record passes the filter."""
        names = self.vessel in (None, vessel_id) and self.vehicle in (None, vehicle_id)
        return names and self.since_utc_s <= time_utc_s < self.until_utc_s


@dataclass(frozen=True, slots=True)
class ListedImage:
    """An image and the latest decision about it."""

    image: ImageRow
    decision: DecisionRow | None


def add_actions(parser: CommandParser) -> None:
    """Add the actions `ls`, `get` and `export`."""
    ls = parser.add_action(
        "ls", "list images with their decisions, or commands and comments", run_ls, "--since 24h --json"
    )
    add_filters(ls)
    flag(ls, "--undecided", "only images without a decision")
    flag(ls, "--all-versions", "all versions of an image, not only the newest")
    flag(ls, "--tasking", "commands and comments, with their delivery state")
    flag(ls, "--json", "print one JSON object for each line")

    get = parser.add_action("get", "copy the TIFF, PNG and JSON files of one image", run_get, "uuv-1/0001")
    option(get, "image VEHICLE/IMAGE", "name from `ls`, or the name of the files")
    option(get, "--vessel NAME", "vessel, if two vessels have an image of this name")
    option(get, "--version N", "version (default: the newest)", int)
    option(get, "--out DIR", "destination (default: current folder)", Path, Path())
    _add_archive(get)

    export = parser.add_action(
        "export",
        "write the contacts as GeoJSON, KML, GeoPackage or in another format",
        run_export,
        "--out contacts.geojson --out contacts.kmz",
    )
    add_filters(export)
    option(
        export,
        "--out FILE",
        "file to write, named *." + ", *.".join(exporters().names()) + "; can be repeated",
        Path,
        action="append",
        required=True,
    )


def _add_archive(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    option(
        where,
        "--archive DIR",
        f"folder of c2, or address of its database, postgresql://USER@HOST/NAME (default: {DEMO_IMAGES} if there"
        f" is one, else that of {SHORE_CONFIG}, else out)",
    )
    option(where, "--config FILE", "TOML file of the shore site; its database or out_dir is used", Path)


def archive_of(parsed: argparse.Namespace) -> ArchivePlace:
    """Return the archive of c2 that the options select; one that they do not name is printed on standard error.

    Raises:
        ConfigError: The configuration file is invalid.
    """
    if parsed.archive is not None:
        return place_of(parsed.archive, "c2 --archive")
    path: Path | None = parsed.config
    place: ArchivePlace = DEMO_IMAGES
    if path is None and not DEMO_IMAGES.is_dir():
        path = SHORE_CONFIG if SHORE_CONFIG.is_file() else None
        place = Path("out")
    if path is not None:
        config = load(path, "c2", C2Config, os.environ)[1]
        place = config.database_address() or config.out_dir
    noun = "folder" if isinstance(place, Path) else "database"
    print(f"sonarpost c2: {noun} {place}", file=sys.stderr)
    return place


def add_filters(parser: argparse.ArgumentParser) -> None:
    """Add the options of `archive_of` and of `RecordFilter`."""
    _add_archive(parser)
    option(parser, "--vessel NAME", "only this vessel")
    option(parser, "--vehicle NAME", "only this vehicle")
    option(parser, "--since TIME", "first received since 90m, 2h or 3d ago, or since a UTC time")
    option(parser, "--until TIME", "first received before such a time")


def time_of(option: str, text: str, now_utc_s: float | None = None) -> float:
    """Return the value of an option as UTC seconds: 90m, 2h, 3d ago, or a time like 2026-11-21T08:30:00.

    Raises:
        ConfigError: The text has another form.
    """
    if ago := _AGO.fullmatch(text):
        now = time.time() if now_utc_s is None else now_utc_s
        return now - float(ago.group(1)) * _UNIT_S[ago.group(2)]
    try:
        when = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError("c2", option, text, "45s, 90m, 2h, 3d, or a time like 2026-11-21T08:30:00") from error
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


# ls


def run_ls(parsed: argparse.Namespace) -> int:
    """Print the table of images, or of commands and comments; return 0."""
    record_filter = RecordFilter.of(parsed)
    with open_reader(archive_of(parsed)) as index:
        if parsed.tasking:
            _print_tasking(index.tasking(), record_filter, as_json=parsed.json)
            return 0
        images = join_decisions(index.images(), index.decisions())
    rows = select_images(images, record_filter, undecided=parsed.undecided, all_versions=parsed.all_versions)
    if parsed.json:
        for row in rows:
            decision = None if row.decision is None else document_of(row.decision)
            print(json.dumps({**document_of(row.image), "decision": decision}))
    else:
        _print_images(rows)
    return 0


def join_decisions(images: Sequence[ImageRow], decisions: Iterable[DecisionRow]) -> list[ListedImage]:
    """Join every image with the latest decision about it; see `match_start_time` for repeated image identifiers."""
    start_times: dict[tuple[str, str, str], list[float]] = {}
    for row in images:
        known = start_times.setdefault((row.vessel_id, row.vehicle_id, row.image_id), [])
        if row.first_frame_utc_s not in known:
            known.append(row.first_frame_utc_s)
    latest: dict[tuple[str, str, str, float], DecisionRow] = {}
    for decision in sorted(decisions, key=lambda d: (d.decided_utc_s, d.decision_id)):
        name = (decision.vessel_id, decision.vehicle_id, decision.image_id)
        start = match_start_time(start_times.get(name, ()), decision.decided_utc_s)
        if start is not None:
            latest[(*name, start)] = decision
    return [ListedImage(row, latest.get(_image_key(row))) for row in images]


def _image_key(row: ImageRow) -> tuple[str, str, str, float]:
    """Return the key of an image, which is the same for all its versions."""
    return row.vessel_id, row.vehicle_id, row.image_id, row.first_frame_utc_s


def select_images(
    images: Iterable[ListedImage],
    record_filter: RecordFilter,
    *,
    undecided: bool = False,
    all_versions: bool = False,
) -> list[ListedImage]:
    """Return the images that match the options of `ls`, in the given order."""
    rows = [
        row
        for row in images
        if record_filter.accepts(row.image.vessel_id, row.image.vehicle_id, row.image.first_frame_utc_s)
        and not (undecided and row.decision is not None)
    ]
    if all_versions:
        return rows
    newest: dict[tuple[str, str, str, float], ListedImage] = {}
    for row in rows:
        key = _image_key(row.image)
        if key not in newest or newest[key].image.version < row.image.version:
            newest[key] = row
    return [row for row in rows if row is newest[_image_key(row.image)] or row.image.conflict]


def _print_images(rows: Sequence[ListedImage]) -> None:
    headings = ("vessel", "image", "v", "first received (UTC)", "missing", "position", "detector", "decision", "by")
    cells = []
    for row in rows:
        image, decision = row.image, row.decision
        contact = image.contact or Contact(contact_id="none", vehicle_id=image.vehicle_id)
        located = contact.lat_deg is not None and contact.lon_deg is not None
        confidence = "" if contact.atd_confidence is None else f"{contact.atd_confidence:.2f}"
        named = " ".join(part for part in (contact.atd_class or "", confidence) if part)
        cells.append(
            (
                image.vessel_id,
                f"{image.vehicle_id}/{image.image_id}",
                _version_text(image),
                time_text(image.first_frame_utc_s),
                f"{100 * image.missing_fraction:.0f} %",
                f"{contact.lat_deg:.5f} {contact.lon_deg:.5f}" if located else "",
                ", ".join(
                    part for part in (named, probabilities_text(contact.p_mine_like, contact.p_other_object)) if part
                ),
                "" if decision is None else " ".join(p for p in (decision.verdict, decision.mlo_class or "") if p),
                "" if decision is None else decision.operator,
            )
        )
    _print_table(headings, cells, "images")


def _version_text(image: ImageRow) -> str:
    notes = [*(["conflict"] if image.conflict else []), *([image.fault] if image.fault else [])]
    return f"{image.version} ({', '.join(notes)})" if notes else str(image.version)


def _print_tasking(rows: Iterable[TaskingRow], record_filter: RecordFilter, *, as_json: bool) -> None:
    chosen = [row for row in rows if record_filter.accepts(row.vessel_id, row.vehicle_id, row.issued_utc_s)]
    if as_json:
        for row in chosen:
            print(json.dumps(document_of(row)))
        return
    headings = ("vessel", "kind", "id", "image", "text", "by", "issued (UTC)", "state", "reason")
    cells = []
    for row in chosen:
        image = row.vehicle_id if row.image_id is None else f"{row.vehicle_id}/{row.image_id}"
        issued = time_text(row.issued_utc_s)
        names = (row.vessel_id, row.kind, row.record_id, image)
        cells.append((*names, row.summary, row.author, issued, row.state, row.reason))
    _print_table(headings, cells, "records")


def _print_table(headings: Sequence[str], rows: Sequence[Sequence[str]], noun: str) -> None:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    console = Console(highlight=False)
    if not console.is_terminal:
        # A fixed width prints one line for each row, as `grep` needs.
        console = Console(highlight=False, width=PIPED_WIDTH)
    console.print(table)
    console.print(f"{len(rows)} {noun}")


# get


def run_get(parsed: argparse.Namespace) -> int:
    """Copy the files of an image and print their paths; return 0."""
    place = archive_of(parsed)
    with open_reader(place) as index:
        row = find_image(index.images(), parsed.image, parsed.vessel, parsed.version)
    copies = [(parsed.out / name, content) for name, content in read_image_files(place, row).items()]
    make_output_folder(parsed.out)
    for path, data in copies:
        write_atomically(path, data)
        print(path)
    return 0


# export


def run_export(parsed: argparse.Namespace) -> int:
    """Export contacts; return 0, or 1 if a stored file was rejected."""
    outputs = _export_files(parsed)
    record_filter = RecordFilter.of(parsed)
    place = archive_of(parsed)
    with ExitStack() as stack:
        with ProgressDisplay(step=f"reading {place}"):
            # Exports need no TIFF files.
            contacts = load_contacts(stack.enter_context(as_folder(place, (".json", ".png"))))
        return _write_contacts(place, contacts, outputs, record_filter)


def _write_contacts(
    place: ArchivePlace,
    contacts: ContactSet,
    outputs: Sequence[tuple[str, Path]],
    record_filter: RecordFilter,
) -> int:
    chosen = tuple(
        contact
        for contact in contacts.contacts
        if record_filter.accepts(contact.image.vessel_id, contact.image.vehicle_id, contact.image.first_frame_utc_s)
    )
    contacts = replace(contacts, contacts=chosen)
    problems = list(contacts.problems)
    for name, path in outputs:
        with ProgressDisplay(step=f"writing {path}"):
            problems += write_export(name, in_new_folder(path), contacts)
        print(f"{path}: {len(contacts.contacts)} contacts, {len(contacts.unlocated)} of them without a position")
    _mark_exported(place, contacts.contacts)
    return EXIT_INCOMPLETE if print_rejected(problems) else 0


def _export_files(parsed: argparse.Namespace) -> list[tuple[str, Path]]:
    """Return format and path of every file to write."""
    files = []
    names = exporters().names()
    for path in parsed.out:
        name = next((name for name in names if path.name.lower().endswith(f".{name}")), None)
        if name is None:
            raise ConfigError("c2 export", "--out", str(path), "a name that ends in ." + ", .".join(names))
        files.append((name, path))
    return files


def _mark_exported(place: ArchivePlace, contacts: Sequence[ExportContact]) -> None:
    """Mark images as exported in the index; retention deletes exported images first."""
    exported = {(c.image.vessel_id, c.image.vehicle_id, c.image.image_id, c.image.first_frame_utc_s) for c in contacts}
    try:
        with open_reader(place, writable=True) as index:
            rows = [row for row in index.images() if _image_key(row) in exported]
            index.mark("exported_utc_s", rows, time.time())
    except (OSError, DeliveryError, BadInputError) as error:
        print(f"not marked as exported: {error}", file=sys.stderr)
