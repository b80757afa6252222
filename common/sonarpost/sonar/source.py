"""A survey that is read ping by ping, however long the recording is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.navigation import NavigationStatistics, PositionJumpFilter, mounted
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.survey import Ping, Side, Survey

MAX_HELD_BYTES: Final = 1 << 30
"""Of samples that a survey held in memory may have; a longer recording is read in blocks."""
STRIP_BYTES: Final = 1 << 26
"""Of samples that a strip holds: the detector needs about twenty times as much to work on it."""


@dataclass(frozen=True, slots=True)
class SurveyInfo:
    """What is known of a recording once it has been walked through.

    Attributes:
        path: Where it is.
        sonar_id: Name of the sonar as the file gives it, or "unknown".
        line_name: Survey line, normally the file's stem.
        ping_count: Pings that `pings()` gives.
        sides: Sides that at least one ping has, port first.
        warnings: What was met and could be explained, one line each.
    """

    path: Path
    sonar_id: str
    line_name: str
    ping_count: int
    sides: tuple[Side, ...]
    warnings: tuple[str, ...]


class SurveySource(ABC):
    """An open recording: a description, and as many walks through its pings as are asked for."""

    info: SurveyInfo
    options: SurveyOptions

    @abstractmethod
    def pings(self) -> Iterator[Ping]:
        """Yield the pings in the order of recording, the same ones each time.

        Raises:
            SurveyFileError: The file was changed since it was opened, or can no longer be read.
        """

    def close(self) -> None:  # noqa: B027 - a source that holds no file has nothing to close
        """Close what is open; more than once does no harm."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class StreamedSource(SurveySource):
    """A source over a file: a reader fills in `_walk`, the checks that all formats share are made here.

    A first walk when it is opened validates the whole file and collects the warnings; memory does not grow with the
    file's length. A subclass prepares itself in its own `__init__`, then calls `_scan`.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        self.path = path
        self.options = options

    @abstractmethod
    def _walk(self, *, first: bool) -> Iterator[Ping]:
        """Yield the pings as the file has them; on the first walk also collect what `_notes` tells."""

    def _notes(self) -> list[str]:
        """Return the format's own warnings after the first walk."""
        return []

    def _scan(self, sonar_id: str, line_name: str) -> None:
        """Walk through the whole file and describe it.

        Raises:
            SurveyFileError: The file is damaged, or has no ping with a port or starboard channel.
        """
        scan = NavigationStatistics(self.options.mounting)
        sides: set[Side] = set()
        count = 0
        for ping in self._walk(first=True):
            scan.observe(count, ping)
            sides.update(channel.side for channel in ping.channels)
            count += 1
        if not sides:
            raise SurveyFileError(str(self.path), "pings", count, "at least one ping with a port or starboard channel")
        warnings = (*self._notes(), *scan.warnings(count))
        ordered = tuple(side for side in Side if side in sides)
        self.info = SurveyInfo(self.path, sonar_id, line_name, count, ordered, warnings)

    def pings(self) -> Iterator[Ping]:
        """Yield the pings with implausible fixes left out and the sonar's mounting applied."""
        gate = PositionJumpFilter()
        for ping in self._walk(first=False):
            yield mounted(gate.checked(ping), self.options.mounting)


class InMemorySource(SurveySource):
    """A survey in memory as a source, for formats whose reader holds the whole file anyway."""

    def __init__(self, survey: Survey, options: SurveyOptions) -> None:
        self.options = options
        scan = NavigationStatistics(options.mounting)
        for row, ping in enumerate(survey.pings):
            scan.observe(row, ping)
        gate = PositionJumpFilter()
        pings = tuple(mounted(gate.checked(ping), options.mounting) for ping in survey.pings)
        self._survey = replace(survey, pings=pings)
        warnings = (*survey.warnings, *scan.warnings(len(pings)))
        self.info = SurveyInfo(survey.path, survey.sonar_id, survey.line_name, len(pings), survey.sides(), warnings)

    def pings(self) -> Iterator[Ping]:
        """Yield the pings."""
        return iter(self._survey.pings)


def gather(source: SurveySource, max_bytes: int = MAX_HELD_BYTES) -> Survey:
    """Hold a whole source in memory.

    Args:
        source: The recording.
        max_bytes: Of samples that may be held.

    Raises:
        SurveyFileError: It has more, or cannot be read.
    """
    info = source.info
    held = 0
    pings = []
    for ping in source.pings():
        held += sum(channel.samples.nbytes for channel in ping.channels)
        if held > max_bytes:
            raise SurveyFileError(str(info.path), "samples", f"more than {max_bytes} bytes", "a recording in blocks")
        pings.append(ping)
    return Survey(info.path, info.sonar_id, info.line_name, tuple(pings), info.warnings)


def blocks(source: SurveySource, length: int = 1000, overlap: int = 0) -> Iterator[tuple[int, Survey]]:
    """Cut a recording into surveys that fit into memory.

    Args:
        source: The recording.
        length: New pings of each block, at least 1.
        overlap: Pings before and after the new ones, for filters that look around.

    Yields:
        How many pings of the block's beginning are overlap, and the block: its first ones and its last `overlap`
        are overlap (the last block has no later ones).

    Raises:
        ValueError: A length below 1 or an overlap below 0.
        SurveyFileError: The file can no longer be read.
    """
    if length < 1 or overlap < 0:
        raise ValueError(f"block of {length} with overlap {overlap}, expected at least 1 and 0")
    info = source.info
    pings = source.pings()
    before: deque[Ping] = deque(maxlen=overlap)
    ahead = list(islice(pings, length + overlap))
    while ahead:
        rows = (*before, *ahead)
        yield len(before), Survey(info.path, info.sonar_id, info.line_name, rows, info.warnings)
        new, rest = ahead[:length], ahead[length:]
        before.extend(new)
        ahead = rest + list(islice(pings, length + overlap - len(rest))) if len(new) == length else []


@dataclass(frozen=True, slots=True)
class Strip:
    """A piece of a stream of pings.

    Attributes:
        first_row: Place of its first ping in the stream.
        pings: The pings; the last ones of a strip are the first ones of the next.
        is_last: Nothing follows it.
    """

    first_row: int
    pings: tuple[Ping, ...]
    is_last: bool


def strips(
    pings: Iterable[Ping], length: int = 1000, overlap: int = 0, max_bytes: int = STRIP_BYTES
) -> Iterator[Strip]:
    """Cut a stream of pings, of one recording or of several that follow each other, into pieces that fit into memory.

    What is left at the end and shorter than half a strip goes with the strip before it.

    Args:
        pings: The stream.
        length: Pings of a strip, more than `overlap`; the last one may have up to half as many more, or fewer.
        overlap: Pings that a strip has in common with the next.
        max_bytes: Of samples that are held; strips of long pings are shorter.

    Yields:
        The strips in order; none for an empty stream.

    Raises:
        ValueError: A length not above the overlap, or an overlap below 0.
        SurveyFileError: `max_bytes` do not hold twice the overlap.
    """
    if overlap < 0 or length <= overlap:
        raise ValueError(f"strips of {length} with overlap {overlap}, expected more than the overlap, from 0")
    held: list[Ping] = []
    size = first_row = 0
    for ping in pings:
        if len(held) >= length + length // 2 or (size > max_bytes and len(held) > 2 * overlap + 1):
            new = max(2 * len(held) // 3, overlap + 1)
            yield Strip(first_row, tuple(held[:new]), is_last=False)
            del held[: new - overlap]
            first_row += new - overlap
            size = sum(map(_size_bytes, held))
        held.append(ping)
        size += _size_bytes(ping)
        if size > 2 * max_bytes:
            # The row counts within the stream, which may have begun in another file.
            where, value = (
                f"survey, row {first_row + len(held) - 1}",
                f"over {2 * max_bytes} bytes in {len(held)} pings",
            )
            raise SurveyFileError(where, "samples", value, "pings of fewer samples")
    if held:
        yield Strip(first_row, tuple(held), is_last=True)


def _size_bytes(ping: Ping) -> int:
    return sum(channel.samples.nbytes for channel in ping.channels)
