"""Files of picks beside surveys: `NAME.picks` beside `NAME`, a line `ping,side,sample` for each contact to send."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgpack

from sonarpost.detection.picks import (
    MAX_PICKS_BYTES,
    PICKS_SUFFIX,
    PickedDetection,
    locate_picks,
    measure_picks,
    parse_picks,
)
from sonarpost.detection.stream import FileOrigin, PingOrigin
from sonarpost.files import open_regular
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.input_folder import InputFile, list_input_files, printable
from sonarpost.services.atd_stub.survey_detection import snippet_of
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.survey import Survey

STATE_PREFIX: Final = "picks:"


@dataclass(frozen=True, slots=True)
class PicksResult:
    """The contacts of the new picks of a survey.

    Attributes:
        snippets: A snippet for each contact, in the order of the file.
        handled: The lines that are handled now, those of earlier calls included.
        errors: The error of each new line that is no pick of this survey.
    """

    snippets: tuple[Snippet, ...]
    handled: tuple[str, ...]
    errors: tuple[str, ...]

    def pack(self, now_utc_s: float) -> bytes:
        """Return `handled` for the store."""
        packed: bytes = msgpack.packb({"handled": list(self.handled), "processed_utc_s": now_utc_s})
        return packed


def handled_lines(packed: bytes) -> tuple[str, ...]:
    """Return `PicksResult.handled` of a stored result."""
    return tuple(map(str, msgpack.unpackb(packed)["handled"]))


def list_picks_files(
    folder: Path, surveys: Iterable[InputFile]
) -> tuple[dict[InputFile, InputFile], Mapping[str, str]]:
    """Return the files of picks in a folder whose survey is among `surveys`, each with its survey.

    The second value is `InputFolder.unreadable`.

    Raises:
        OSError: The folder cannot be read.
    """
    by_name = {file.path.name: file for file in surveys}
    found = list_input_files(folder, (PICKS_SUFFIX,))
    surveys_of = {file: by_name.get(file.path.name[: -len(PICKS_SUFFIX)]) for file in found.files}
    return {file: survey for file, survey in surveys_of.items() if survey is not None}, found.unreadable


def contacts_of_picks(
    survey_path: Path, content: str, picks_path: Path, before: Sequence[str], vehicle_id: str, config: AtdStubConfig
) -> PicksResult:
    """Measure the picks of a file that were not handled before.

    Args:
        survey_path: The survey.
        content: Hex SHA-256 of the survey.
        picks_path: The file of picks.
        before: `PicksResult.handled` of the last call for this survey; empty for the first one.
        vehicle_id: This vehicle.
        config: Settings of the detector, size of the snippets, and what the survey does not contain.

    Raises:
        OSError: A file cannot be read.
        SurveyFileError: The survey cannot be read.
    """
    with os.fdopen(open_regular(picks_path), "rb") as file:
        picks, syntax_errors = parse_picks(file.read(MAX_PICKS_BYTES + 1), printable(picks_path.name))
    # Invalid lines are reported once, like picks are sent once.
    errors = {str(error): None for error in syntax_errors if str(error) not in before}
    new = [pick for pick in picks if str(pick) not in before]

    def describe(survey: Survey, picked: PickedDetection, origin: PingOrigin) -> Snippet:
        record = picked.record(origin.file, vehicle_id, survey.sonar_id)
        return snippet_of(survey, picked.detection, origin.file, record, config)

    snippets: list[Snippet] = []
    if new:
        with open_survey(survey_path, config) as source:
            located, outside = locate_picks(source, new, printable(picks_path.name))
            origin = FileOrigin.of(source, content)
            snippets = measure_picks(source, origin, located, describe, config.detector_settings())
        errors |= {str(error): None for error in outside}
    # Two picks may be on one object.
    by_id = {snippet.contact.contact_id: snippet for snippet in snippets}
    return PicksResult(tuple(by_id.values()), (*before, *map(str, new), *errors), tuple(errors))
