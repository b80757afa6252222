"""`sonarpost detect --pick PING,SIDE,SAMPLE`: contacts at places that a person gives."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from sonarpost.cli.shared import option
from sonarpost.detection.detector import Detection
from sonarpost.detection.picks import (
    DescribePick,
    LocatedPick,
    is_at_detection,
    locate_picks,
    measure_picks,
    parse_pick,
)
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import FileOrigin
from sonarpost.errors import ConfigError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey

T = TypeVar("T")

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


def contacts_of_picks(
    path: Path,
    origin: FileOrigin,
    picks: Sequence[LocatedPick],
    listed: Sequence[Detection],
    describe: DescribePick[T],
    settings: DetectorSettings,
    options: SurveyOptions,
) -> tuple[frozenset[int], list[T]]:
    """Return which detections of a file are picked, and what `describe` returns for the other picks.

    Args:
        path: The survey file.
        origin: The same, as the origin of its pings.
        picks: Picks in this file.
        listed: Detections in this file; their ping indices are those of the file.
        describe: Called for each pick that is on none of them.
        settings: Settings of the detector.
        options: Survey options.
    """
    on_listed: set[int] = set()
    others = []
    for each in picks:
        number = next((n for n, d in enumerate(listed) if is_at_detection(d, each.row, each.pick, settings)), None)
        if number is None:
            others.append(each)
        else:
            on_listed.add(number)
    if not others:
        return frozenset(on_listed), []
    with open_survey(path, options) as source:
        return frozenset(on_listed), measure_picks(source, origin, others, describe, settings)
