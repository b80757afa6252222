"""Which reader opens which survey file.

A reader is a function from a path to a `Survey`; it raises `SurveyFileError` and nothing else for a bad file. A new
format is one `register_reader` call beside the reader.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.survey import Survey
from sonarpost.sonar.xtf_reader import read_xtf

SurveyReader = Callable[[Path], Survey]

_READERS: dict[str, SurveyReader] = {}


def register_reader(suffixes: Iterable[str], reader: SurveyReader) -> None:
    """Let `reader` open files of these suffixes.

    Args:
        suffixes: File suffixes with the dot, in any case.
        reader: The function that reads them.

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
    """Return the suffixes that have a reader, lower case, sorted."""
    return tuple(sorted(_READERS))


def read_survey(path: Path) -> Survey:
    """Read a survey file of any supported format, chosen by its suffix.

    Args:
        path: The file.

    Raises:
        SurveyFileError: No reader for the suffix, or the reader refuses the file.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        expected = "one of " + ", ".join(supported_suffixes())
        raise SurveyFileError(str(path), "suffix", path.suffix, expected)
    return reader(path)


register_reader((".xtf",), read_xtf)

SUPPORTED_SUFFIXES: tuple[str, ...] = supported_suffixes()
"""Suffixes of the readers that come with the package; `supported_suffixes()` also has those registered later."""
