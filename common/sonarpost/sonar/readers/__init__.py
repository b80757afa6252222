"""Registry of the survey readers.

A reader is a function from a path and options to an open `SurveySource`. For a bad file it raises `SurveyFileError`
only. Other packages add formats by entry points of the group `sonarpost.survey_readers`: the name is the suffix
without its dot, the object is the reader (example: docs/how-to/survey-reader.md). A reader of recordings of several
files names them with its attribute `parts`, see `recording_parts`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Final

from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.registry import Registry
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.humminbird import HumminbirdSource
from sonarpost.sonar.readers.jsf import JsfSource
from sonarpost.sonar.readers.lowrance import LowranceSource
from sonarpost.sonar.readers.sdf import SdfSource
from sonarpost.sonar.readers.svlog import SvlogSource
from sonarpost.sonar.readers.waterfall_images import WaterfallSource
from sonarpost.sonar.readers.xtf import XtfSource
from sonarpost.sonar.source import SurveySource, load_survey
from sonarpost.sonar.survey import Survey

SurveyReader = Callable[[Path, SurveyOptions], SurveySource]

ENTRY_POINTS = "sonarpost.survey_readers"
_CORE: Final[Mapping[str, SurveyReader]] = {
    "xtf": XtfSource,
    "dat": HumminbirdSource,
    "jsf": JsfSource,
    "sdf": SdfSource,
    "sl2": LowranceSource,
    "sl3": LowranceSource,
    "svlog": SvlogSource,
    "waterfall.toml": WaterfallSource,
}


@cache
def survey_readers() -> Registry[SurveyReader]:
    """Return the readers by suffix without its dot, lower case."""
    return Registry(ENTRY_POINTS, "a function", lambda found, _: callable(found), _CORE)


def supported_suffixes() -> tuple[str, ...]:
    """Return the suffixes that have a reader, including plug-ins, lower case, sorted."""
    return tuple(f".{name}" for name in survey_readers().names())


def recording_parts(path: Path) -> tuple[Path, ...]:
    """Return the files of a recording, those that are missing included; the given one is first.

    A reader whose recordings consist of several files has a function `parts` from the path to the paths of all of them,
    the given one included. It names the files that must exist, and others of the recording that exist. It returns the
    given path alone if that file does not name the others yet. A reader without `parts` reads one file.

    Raises:
        SurveyFileError: No reader for the suffix, or a plug-in that cannot be loaded.
        OSError: A folder cannot be read.
    """
    parts: Callable[[Path], Iterable[Path]] | None = getattr(_reader(path), "parts", None)
    if parts is None:
        return (path,)
    named = (Path(os.path.normpath(part)) for part in parts(path))
    return tuple(dict.fromkeys((path, *named)))


def open_survey(path: Path | str, options: SurveyOptions | None = None) -> SurveySource:
    """Open a survey file of any supported format for reading ping by ping. The suffix selects the reader.

    Args:
        path: The file.
        options: None for the defaults.

    Returns:
        The open recording, a context manager.

    Raises:
        SurveyFileError: No reader for the suffix, or the file is invalid.
    """
    path = Path(path)
    return _reader(path)(path, options or SurveyOptions())


def read_survey(path: Path, options: SurveyOptions | None = None) -> Survey:
    """Read a survey file of any supported format into memory.

    Raises:
        SurveyFileError: No reader for the suffix, an invalid file, or more than 1 GiB of samples.
    """
    with open_survey(path, options) as source:
        return load_survey(source)


def _reader(path: Path) -> SurveyReader:
    name = path.name.lower()
    matching = [suffix for suffix in supported_suffixes() if name.endswith(suffix)]
    if not matching:
        raise SurveyFileError(str(path), "suffix", path.suffix, "one of " + ", ".join(supported_suffixes()))
    try:
        return survey_readers().get(max(matching, key=len).removeprefix("."))
    except ConfigError as error:
        raise SurveyFileError(str(path), error.where, error.value, error.expected) from error
