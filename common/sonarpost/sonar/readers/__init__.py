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
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Final

from sonarpost.errors import SurveyFileError
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
_READERS: Final[Mapping[str, SurveyReader]] = {
    ".xtf": XtfSource,
    ".dat": HumminbirdSource,
    ".jsf": JsfSource,
    ".sdf": SdfSource,
    ".sl2": LowranceSource,
    ".sl3": LowranceSource,
    ".svlog": SvlogSource,
    ".waterfall.toml": WaterfallSource,
}


def supported_suffixes() -> tuple[str, ...]:
    """Return the suffixes that have a reader, including plug-ins, lower case, sorted."""
    return tuple(sorted({*_READERS, *_plug_ins()}))


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
    suffix = max(matching, key=len)
    # The readers of the package have priority: a plug-in does not replace them.
    return _READERS[suffix] if suffix in _READERS else _load_plug_in(path, _plug_ins()[suffix])


def _load_plug_in(path: Path, point: EntryPoint) -> SurveyReader:
    try:
        reader: SurveyReader = point.load()
    except Exception as error:  # importing a plug-in may raise anything
        value = f"{point.value}: {type(error).__name__}: {error}"
        raise SurveyFileError(str(path), f"survey reader {point.name}", value, "a plug-in that loads") from error
    if not callable(reader):
        raise SurveyFileError(str(path), f"survey reader {point.name}", point.value, "a callable")
    return reader


@cache
def _plug_ins() -> dict[str, EntryPoint]:
    """Return suffix to entry point. A plug-in is imported only when its suffix is used."""
    return {f".{point.name.lower()}": point for point in entry_points(group=ENTRY_POINTS)}
