"""Options of `sonarpost detect`: `--pick` places of contacts, `--transmissions` of the vehicle's modem."""

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from sonarpost.cli.shared import option
from sonarpost.detection.picks import LocatedPick, locate_picks, parse_pick
from sonarpost.detection.transmissions import MARGIN_AFTER_S, MARGIN_BEFORE_S, TransmitIntervals
from sonarpost.errors import ConfigError
from sonarpost.messages import Transmission
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey
from sonarpost.wire import first_error

_WHERE = "--pick"


def add_pick_option(parser: argparse.ArgumentParser) -> None:
    """Add --pick."""
    option(
        parser,
        "--pick PING,SIDE,SAMPLE",
        "also list the contact at this place, given as in columns ping, side and sample of the table (index:N,… "
        "is the ping with index N in the file, from 0); repeatable, for one survey file",
        default=[],
        action="append",
    )


def located_picks(texts: Sequence[str], files: Sequence[Path], options: SurveyOptions) -> tuple[LocatedPick, ...]:
    """Return the picks of the command line in the survey file.

    Raises:
        ConfigError: A pick is invalid or outside the recording, or there are several files.
        SurveyFileError: The file cannot be read.
    """
    if not texts:
        return ()
    picks = tuple(dict.fromkeys(parse_pick(text, _WHERE) for text in texts))
    if len(files) != 1:
        raise ConfigError(_WHERE, "survey files", len(files), "one file")
    with open_survey(files[0], options) as source:
        located, errors = locate_picks(source, picks, _WHERE)
    if errors:
        raise errors[0]
    return located


def add_transmission_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that mask transmissions of the vehicle's modem."""
    option(
        parser,
        "--transmissions FILE",
        "mask the pings during the transmissions of the vehicle's modem in this JSON or CSV file, as the vehicle "
        "writes with transmissions_file",
        Path,
    )
    option(
        parser,
        "--transmission-margins BEFORE_S AFTER_S",
        f"seconds masked before and after each transmission (default: {MARGIN_BEFORE_S} {MARGIN_AFTER_S})",
        float,
        (MARGIN_BEFORE_S, MARGIN_AFTER_S),
        nargs=2,
    )


def transmissions_of(parsed: argparse.Namespace) -> TransmitIntervals:
    """Return the times to be masked; none without --transmissions.

    Raises:
        ConfigError: The file or a margin is invalid.
    """
    before_s, after_s = parsed.transmission_margins
    found = () if parsed.transmissions is None else read_transmissions(parsed.transmissions)
    try:
        return TransmitIntervals.of(found, before_s, after_s)
    except ValueError as error:
        value = f"{before_s} {after_s}"
        raise ConfigError("detect", "--transmission-margins", value, "two times of 0 s or more") from error


def read_transmissions(path: Path) -> tuple[tuple[float, float], ...]:
    """Read transmissions from a file.

    A JSON file has one object with the array `transmissions`; its elements, like those of the record `transmissions`,
    have `start_utc_s` and `end_utc_s`. Other members are ignored. A CSV file (suffix `.csv`) has columns of these
    names. Times are seconds since 1970-01-01 UTC, in any order; a transmission lasts at most 300 s.

    Returns:
        Start and end of each, in the order of the file.

    Raises:
        ConfigError: The file cannot be read, has another format, or a transmission is invalid.
    """
    try:
        text = path.read_text(encoding="utf-8")
        rows = _csv_rows(text) if path.suffix.lower() == ".csv" else list(json.loads(text)["transmissions"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError, csv.Error) as error:
        expected = 'an object {"transmissions": […]}, or CSV with columns start_utc_s and end_utc_s'
        raise ConfigError(str(path), "transmissions", f"{type(error).__name__}: {error}", expected) from error
    found = []
    for number, row in enumerate(rows):
        try:
            checked = Transmission.model_validate(row)
        except ValidationError as error:
            field, value, expected = first_error(error)
            raise ConfigError(str(path), f"transmissions.{number}.{field}".rstrip("."), value, expected) from error
        found.append((checked.start_utc_s, checked.end_utc_s))
    return tuple(found)


def _csv_rows(text: str) -> list[dict[str, float]]:
    """Return the rows of a CSV text.

    Raises:
        ValueError, KeyError, TypeError, csv.Error: A column or a number is missing or invalid.
    """
    names = ("start_utc_s", "end_utc_s")
    reader = csv.DictReader(text.splitlines(), strict=True)
    if not set(names) <= set(reader.fieldnames or ()):
        raise KeyError(*names)
    return [{name: float(row[name]) for name in names} for row in reader]
