"""Which reader opens which survey file.

A reader is a function from a path and options to an open `SurveySource`; it raises `SurveyFileError` and nothing else
for a bad file. Packages of others add formats by entry points of the group `sonarpost.survey_readers`: the name is
the suffix without its dot, the object the reader (docs/explanation/surveys.md has an example).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.humminbird import HumminbirdSource
from sonarpost.sonar.readers.waterfall_images import WaterfallSource
from sonarpost.sonar.readers.xtf import XtfSource
from sonarpost.sonar.source import SurveySource, gather
from sonarpost.sonar.survey import Survey

SurveyReader = Callable[[Path, SurveyOptions], SurveySource]

ENTRY_POINTS = "sonarpost.survey_readers"
_READERS: dict[str, SurveyReader] = {}


def register_reader(suffixes: Iterable[str], reader: SurveyReader) -> None:
    """Let `reader` open files of these suffixes.

    Args:
        suffixes: Ends of file names, each with its dot first, in any case; of several that fit the longest counts.
        reader: The function or class that opens them.

    Raises:
        ValueError: A suffix has no dot, or another reader has it.
    """
    for suffix in suffixes:
        key = suffix.lower()
        if not key.startswith(".") or len(key) < 2:
            raise ValueError(f"{suffix!r} is not a file suffix")
        if _READERS.setdefault(key, reader) is not reader:
            raise ValueError(f"{suffix!r} already has a reader")


def supported_suffixes() -> tuple[str, ...]:
    """Return the suffixes that have a reader, plug-ins' included, lower case, sorted."""
    return tuple(sorted({*_READERS, *_plug_ins()}))


def open_survey(path: Path, options: SurveyOptions | None = None) -> SurveySource:
    """Open a survey file of any supported format, chosen by its suffix, to be read ping by ping.

    Args:
        path: The file.
        options: What the file does not say.

    Returns:
        The open recording; a context manager.

    Raises:
        SurveyFileError: No reader for the suffix, or the reader refuses the file.
    """
    return _reader(path)(path, options or SurveyOptions())


def read_survey(path: Path, options: SurveyOptions | None = None) -> Survey:
    """Read a survey file of any supported format into memory.

    Raises:
        SurveyFileError: No reader for the suffix, the reader refuses the file, or it holds over 1 GiB of samples.
    """
    with open_survey(path, options) as source:
        return gather(source)


def _reader(path: Path) -> SurveyReader:
    name = path.name.lower()
    fitting = [suffix for suffix in supported_suffixes() if name.endswith(suffix)]
    if not fitting:
        raise SurveyFileError(str(path), "suffix", path.suffix, "one of " + ", ".join(supported_suffixes()))
    suffix = max(fitting, key=len)
    # What comes with the package goes first: an installed plug-in changes nothing that worked without it.
    return _READERS[suffix] if suffix in _READERS else _loaded(path, _plug_ins()[suffix])


def _loaded(path: Path, point: EntryPoint) -> SurveyReader:
    try:
        reader: SurveyReader = point.load()
    except Exception as error:  # importing a stranger's module may raise anything
        value = f"{point.value}: {type(error).__name__}: {error}"
        raise SurveyFileError(str(path), f"survey reader {point.name}", value, "a plug-in that loads") from error
    if not callable(reader):
        raise SurveyFileError(str(path), f"survey reader {point.name}", point.value, "something to call")
    return reader


@cache
def _plug_ins() -> dict[str, EntryPoint]:
    """Return suffix to entry point; nothing of a plug-in is imported before its suffix is met."""
    return {f".{point.name.lower()}": point for point in entry_points(group=ENTRY_POINTS)}


register_reader((".xtf",), XtfSource)
register_reader((".dat",), HumminbirdSource)
register_reader((".waterfall.toml",), WaterfallSource)

SUPPORTED_SUFFIXES: tuple[str, ...] = (".xtf",)
"""Formats of one file each, which a folder can be watched for; the others are whole only when several files are."""
