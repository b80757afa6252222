"""Survey sources: recordings of any length, read ping by ping."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from typing_extensions import override

from sonarpost.errors import SurveyFileError
from sonarpost.limits import limit
from sonarpost.sonar.channel_sets import ChannelChoice, ChannelSet
from sonarpost.sonar.navigation import HeadingChoice, NavigationChecks, PositionJumpFilter, apply_mounting
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import GridExtent
from sonarpost.sonar.survey import Ping, Side, Survey

MAX_HELD_BYTES: Final = 1 << 30
"""Maximum size of the samples of a survey in memory; a longer recording is read in strips."""
STRIP_BYTES: Final = limit(
    1 << 26, "bytes", "claims", "recording", "recording", "samples of a strip by its longest ping", "shorter strips"
)


@dataclass(frozen=True, slots=True)
class SurveyInfo:
    """Description of a recording, known after the first pass through the file.

    Attributes:
        path: The file.
        sonar_id: Name of the sonar in the file, or "unknown".
        line_name: Survey line, normally the stem of the file name.
        ping_count: Number of pings.
        sides: Sides of all pings together, port first.
        warnings: Irregularities of the file, one line each.
        grid: Extent of the projected coordinates of a file, in metres; None for a file in degrees.
        channel_sets: Frequencies of the sonar, the highest first; the pings are of one of them.
    """

    path: Path
    sonar_id: str
    line_name: str
    ping_count: int
    sides: tuple[Side, ...]
    warnings: tuple[str, ...]
    grid: GridExtent | None = None
    channel_sets: tuple[ChannelSet, ...] = ()


class SurveySource(ABC):
    """An open recording: its description, and iteration over its pings, any number of times.

    Attributes:
        info: Line, sonar, sides, number of pings and warnings.
        options: Options with which it was opened.
    """

    info: SurveyInfo
    options: SurveyOptions

    @abstractmethod
    def pings(self) -> Iterator[Ping]:
        """Yield the pings in the order of recording.

        Raises:
            SurveyFileError: The file has changed since it was opened, or cannot be read.
        """

    def close(self) -> None:  # noqa: B027 - a source without a file has nothing to close
        """Close the files. Closing again has no effect."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class StreamedSource(SurveySource):
    """A source that reads a file with constant memory. It applies the navigation checks that all formats share.

    A subclass implements `_read_pings`, opens its file in `__init__` and then calls `_validate`, which reads the whole
    file once and collects the warnings.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        self.path = path
        self.options = options

    @abstractmethod
    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        """Yield the pings as stored in the file; in the first pass also collect data for `_format_warnings`."""

    def _format_warnings(self) -> list[str]:
        """Return the warnings specific to the format, after the first pass."""
        return []

    def _grid(self) -> GridExtent | None:
        """Return the extent of the coordinates of a file in metres, after the first pass."""
        return None

    def _validate(self, sonar_id: str, line_name: str) -> None:
        """Read the whole file and set `info`.

        Raises:
            SurveyFileError: The file is damaged, or has no ping with a port or starboard channel.
        """
        self._channel_choice = ChannelChoice(self.options.frequency_hz)
        self._heading_choice = HeadingChoice(self.options)
        checks, count = NavigationChecks(self.options.mounting), 0
        for ping in self._read_pings(first_pass=True):
            try:
                self._channel_choice.observe(ping)
            except ValueError as error:
                raise SurveyFileError(str(self.path), "channels", str(error), "those of one sonar") from error
            if ping.channels:
                self._heading_choice.observe(ping)
                checks.observe(count, ping)
                count += 1
        self._channel_choice.choose()
        if not count:
            found = "; ".join([str(count), *self._format_warnings()])
            raise SurveyFileError(str(self.path), "pings", found, "at least one ping with a port or starboard channel")
        if self._channel_choice.left_out:  # rows are those of the pings that `pings` yields
            checks, count = NavigationChecks(self.options.mounting), 0
            for ping in self._of_chosen_set(self._read_pings(first_pass=False)):
                checks.observe(count, ping)
                count += 1
        warnings = (
            *self._format_warnings(),
            *self._channel_choice.warnings(),
            *self._heading_choice.warnings(),
            *checks.warnings(count),
        )
        self.info = SurveyInfo(
            self.path,
            sonar_id,
            line_name,
            count,
            self._channel_choice.sides,
            warnings,
            self._grid(),
            self._channel_choice.sets,
        )

    def _of_chosen_set(self, pings: Iterable[Ping]) -> Iterator[Ping]:
        """Yield the pings of the chosen channel set, with its channels only."""
        return (selected for ping in pings if (selected := self._channel_choice.select(ping)) is not None)

    @override
    def pings(self) -> Iterator[Ping]:
        """Yield the pings of one channel set, without implausible fixes, with heading and mounting applied."""
        jumps = PositionJumpFilter()
        checked = (jumps.filter(ping) for ping in self._of_chosen_set(self._read_pings(first_pass=False)))
        for ping in self._heading_choice.apply(checked):
            yield apply_mounting(ping, self.options.mounting)


class InMemorySource(StreamedSource):
    """A survey in memory as a source, for formats that are read as a whole.

    Raises:
        SurveyFileError: The survey has no ping with a port or starboard channel.
    """

    def __init__(self, survey: Survey, options: SurveyOptions) -> None:
        super().__init__(survey.path, options)
        self._survey = survey
        self._validate(survey.sonar_id, survey.line_name)

    @override
    def _format_warnings(self) -> list[str]:
        return list(self._survey.warnings)

    @override
    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        return iter(self._survey.pings)


def load_survey(source: SurveySource, max_bytes: int = MAX_HELD_BYTES) -> Survey:
    """Load a whole source into memory.

    Raises:
        SurveyFileError: The samples need more than `max_bytes`, or the file cannot be read.
    """
    info = source.info
    held = 0
    pings = []
    for ping in source.pings():
        held += _size_bytes(ping)
        if held > max_bytes:
            raise SurveyFileError(str(info.path), "samples", f"more than {max_bytes} bytes", "a recording in strips")
        pings.append(ping)
    return Survey(info.path, info.sonar_id, info.line_name, tuple(pings), info.warnings)


@dataclass(frozen=True, slots=True)
class Strip:
    """A part of a stream of pings.

    Attributes:
        first_row: Row of its first ping in the stream.
        pings: The pings; the last ones of a strip are the first ones of the next.
        is_last: Whether it is the last strip.
    """

    first_row: int
    pings: tuple[Ping, ...]
    is_last: bool


def strips(
    pings: Iterable[Ping], length: int = 1000, overlap: int = 0, max_bytes: int = STRIP_BYTES
) -> Iterator[Strip]:
    """Divide a stream of pings, of one recording or of consecutive ones, into overlapping strips that fit into memory.

    A remainder shorter than half a strip is added to the last strip.

    Args:
        pings: The stream.
        length: Pings of a strip, more than `overlap`; the last strip has fewer, or up to half as many more.
        overlap: Pings that a strip has in common with the next.
        max_bytes: Target size of the samples in memory, as many for each ping as the longest one of the strip has;
            strips of long pings are shorter.

    Yields:
        The strips in order; none for an empty stream.

    Raises:
        ValueError: A length not above the overlap, or an overlap below 0.
        SurveyFileError: Twice the overlap exceeds `max_bytes`.
    """
    if overlap < 0 or length <= overlap:
        raise ValueError(f"strips of {length} with overlap {overlap}, expected more than the overlap, from 0")
    held: list[Ping] = []
    longest = first_row = 0
    for ping in pings:
        longest = max(longest, _size_bytes(ping))
        while len(held) >= length + length // 2 or (
            (len(held) + 1) * longest > max_bytes and len(held) > 2 * overlap + 1
        ):
            new = max(2 * len(held) // 3, overlap + 1)
            yield Strip(first_row, tuple(held[:new]), is_last=False)
            del held[: new - overlap]
            first_row += new - overlap
            longest = max(map(_size_bytes, (*held, ping)))
        held.append(ping)
        size = len(held) * longest
        if size > 2 * max_bytes:
            # The row is that of the stream, which may have started in another file.
            where = f"survey, row {first_row + len(held) - 1}"
            value = f"over {2 * max_bytes} bytes in {len(held)} pings"
            raise SurveyFileError(where, "samples", value, "pings of fewer samples")
    if held:
        yield Strip(first_row, tuple(held), is_last=True)


def _size_bytes(ping: Ping) -> int:
    return sum(channel.samples.nbytes for channel in ping.channels)
