"""Base of the readers of files: opening and closing, notes of the first pass, fixes and headings that are missing."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar, Final

from typing_extensions import override

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import GridExtent, extended
from sonarpost.sonar.readers.open_file import CheckedFile
from sonarpost.sonar.readers.records import Notes
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import Ping

NO_FIX: Final = "no position fix"
_NO_HEADING: Final = "no heading"


class FileSource(StreamedSource):
    """An open recording of one file or several.

    A subclass implements `_stored_pings`, and `_prepare` if it reads a file header. It gets the notes as an argument:
    those of the first pass are kept, so that every iteration finds the same irregularities and reports them once.

    Raises:
        SurveyFileError: A file of another kind, without a side-scan ping, or unreadable.
    """

    SONAR: ClassVar[str] = "unknown"
    """Name of the sonar, if the file has none."""

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._files: list[CheckedFile] = []
        self._notes = Notes()
        self._extent: GridExtent | None = None
        self._pings = 0
        try:
            for part in self._data_files():
                self._files.append(CheckedFile(part))
            self._prepare()
            self._validate(self._sonar_name() or self.SONAR, path.stem)
        except SurveyFileError as error:
            self.close()
            if error.field == "pings" and (first := self._notes.first_error) is not None:
                raise first from error
            raise
        except BaseException:
            self.close()
            raise

    @property
    def _file(self) -> CheckedFile:
        return self._files[0]

    @override
    def close(self) -> None:
        for file in self._files:
            file.close()

    def _data_files(self) -> Sequence[Path]:
        """Return the files to open."""
        return (self.path,)

    def _prepare(self) -> None:
        """Read what precedes the pings."""

    def _sonar_name(self) -> str:
        """Return the name of the sonar in the file; empty if it has none."""
        return ""

    @abstractmethod
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        """Yield the pings as stored in the file, and note irregularities."""

    @override
    def _grid(self) -> GridExtent | None:
        return self._extent

    @override
    def _format_warnings(self) -> list[str]:
        """Return the notes, and how many pings have no position fix or heading."""
        # Another source of the heading has a note of its own.
        texts = (NO_FIX, _NO_HEADING) if self._heading_choice.source == "sensor" else (NO_FIX,)
        missing = self._notes.pings.lines(self._pings, texts)
        if self._extent is not None and self.options.projected_crs is None:
            missing[0] = "no positions: the file has projected metres; set the option projected_crs (--crs)"
        return [*self._notes.warnings(), *missing]

    @override
    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        notes = self._notes if first_pass else Notes()
        row = 0
        for ping in self._stored_pings(notes):
            if first_pass and ping.grid_m is not None:
                self._extent = extended(self._extent, *ping.grid_m)
            if ping.lat_deg is None:
                notes.pings.add(NO_FIX, row)
            if ping.heading_deg is None:
                notes.pings.add(_NO_HEADING, row)
            row += 1
            yield ping
        self._pings = row
        for file in self._files:
            file.check_unchanged()
