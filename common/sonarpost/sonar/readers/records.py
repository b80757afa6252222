"""Records of a recording one after another, with resynchronisation after a damaged place.

A format describes its records (`RecordFormat`); `records` yields the complete ones. Damage is local: after a place
where no record begins, the next record is searched, and the notes of the reader name place and loss. A record is
accepted after a search only if another record, or the end of the file, follows it, or if its content proves it (a
checksum).

A record whose bytes are complete but which is not followed by another one is doubtful. If a record begins inside it,
bytes of it are missing, and it is left out. Otherwise the damage begins behind it, and it is accepted. In a format with
checksums, a wrong one makes a record doubtful, and the reader rejects it.

Zeros up to the end of the file, and a record that the end of the file cuts, are an end, as after a power failure.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.navigation import PingNotes
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader

_SEARCH_BYTES: Final = 1 << 18
_MAX_CANDIDATES: Final = 4_000_000
"""Maximum number of places at which a search of one pass looks for a record: a bound of time."""
_MIN_PROOF_BYTES, _MAX_PROOFS = 1 << 28, 16
"""Maximum number of bytes that a search of one pass reads to prove records: this, and as a multiple of the file."""
_NAMED_PLACES: Final = 5


class RecordFormat(ABC):
    """Layout of the records of a format.

    Attributes:
        name: What the format calls a record, for messages.
        magic: Bytes at the start of each record; empty if `candidates` finds them otherwise.
        head_bytes: Size of the part that `length` needs.
        min_head_bytes: Less than `head_bytes` where heads vary in size: `length` gets fewer bytes at the end of a file.
        has_checksum: Whether `is_proved` checks every record; else another record that follows proves it.
    """

    name: str
    magic: bytes = b""
    head_bytes: int
    min_head_bytes: int = 0
    has_checksum: bool = False

    @abstractmethod
    def length(self, head: bytes, offset: int) -> int:
        """Return the size of the whole record in bytes; 0 if `head`, which is at `offset`, does not begin one."""

    def candidates(self, data: bytes, offset: int) -> Iterator[int]:
        """Yield the indices in `data`, which is at `offset` of the file, at which a record may begin."""
        found = data.find(self.magic)
        while found >= 0:
            yield found
            found = data.find(self.magic, found + 1)

    def is_proved(self, raw: bytes) -> bool:
        """Return whether the content of a whole record proves that it is one, for example by a checksum."""
        return False


class Notes:
    """Irregularities of a file, found while it is read: texts with their numbers, and damaged places."""

    def __init__(self) -> None:
        self._texts: Counter[str] = Counter()
        self._damage: list[str] = []
        self._damaged_places = 0
        self._ends: list[str] = []
        self.first_error: SurveyFileError | None = None
        self.pings = PingNotes()
        """Irregularities of single pings, which `warnings` does not include."""

    def add(self, text: str, count: int = 1) -> None:
        """Count an irregularity."""
        self._texts[text] += count

    def lost(self, name: str, first: int, end: int) -> None:
        """Note that no record, called `name`, was found in the bytes from `first` up to `end`, not included."""
        self._add_damage(f"no {name} at bytes {first} to {end - 1}: {end - first} bytes are left out")

    def ended(self, text: str) -> None:
        """Note that a file ends otherwise than with a whole record."""
        self._ends.append(text)

    @contextmanager
    def leaving_out(self, place: str) -> Iterator[None]:
        """Leave out a record whose content raises a `SurveyFileError`: the body ends, and the error becomes a note."""
        try:
            yield
        except SurveyFileError as error:
            self.first_error = self.first_error or error
            self._add_damage(f"{place} is left out: {_reason(error, place)}")

    def warnings(self) -> list[str]:
        """Return one line for each kind of irregularity, the damage first."""
        damage = self._damage[:]
        if (more := self._damaged_places - len(damage)) > 0:
            damage.append(f"{more} more damaged places")
        return [*damage, *self._ends, *(f"{text} ({count} times)" for text, count in sorted(self._texts.items()))]

    def _add_damage(self, text: str) -> None:
        self._damaged_places += 1
        if len(self._damage) < _NAMED_PLACES:
            self._damage.append(text)


def _reason(error: SurveyFileError, place: str) -> str:
    """Return an error without file and place, which stand beside it."""
    return str(error).replace(f"{place}, ", "").removeprefix(f"{error.where}: ")


class _Search:
    """Finds records in a file, with a bounded number of attempts."""

    def __init__(self, reader: SequentialReader, layout: RecordFormat) -> None:
        self._file, self._layout, self._reader = reader.file, layout, reader
        self._min_head_bytes = layout.min_head_bytes or layout.head_bytes
        self._attempts = self._proof_bytes = 0
        self.zeros_from = _zeros_from(self._file)
        """Offset from which on the file consists of zeros; its size if it ends otherwise."""

    def length_at(self, offset: int) -> int:
        """Return the size of the record at `offset`; 0 if none begins there."""
        head = self._reader.peek(offset, self._layout.head_bytes)
        return self._layout.length(head, offset) if len(head) >= self._min_head_bytes else 0

    def is_followed(self, end: int) -> bool:
        """Return whether `end` is the end of the file, or the start of a record or of zeros up to the end."""
        if end >= self.zeros_from:
            return True
        head = self._reader.peek(end, self._layout.head_bytes)
        if len(head) < self._min_head_bytes:
            magic = self._layout.magic
            return head[: len(magic)] == magic[: len(head)]
        return self._layout.length(head, end) > 0

    def next_record(self, start: int) -> int | None:
        """Return the offset of the next record from `start` on; None if there is none."""
        size = self._file.size_bytes
        while start < size:
            data = self._reader.peek(start, min(_SEARCH_BYTES, size - start))
            # Heads at the end of the part are found in the next one.
            last = len(data) - (self._min_head_bytes if start + len(data) == size else self._layout.head_bytes)
            for index in self._layout.candidates(data, start):
                if index > last:
                    break
                self._attempts += 1
                self._check(start + index)
                offset = start + index
                length = self._layout.length(data[index : index + self._layout.head_bytes], offset)
                if length and offset + length <= size and self._is_record(offset, length):
                    return offset
            if start + len(data) >= size:
                return None
            start += max(last + 1, 1)
        return None

    def is_sound(self, offset: int, length: int) -> bool:
        """Return whether a whole record has the right checksum; in a format without, whether one follows it."""
        return self._is_proved(offset, length) if self._layout.has_checksum else self.is_followed(offset + length)

    def _is_record(self, offset: int, length: int) -> bool:
        if not self._layout.has_checksum and self.is_followed(offset + length):
            return True
        self._proof_bytes += length
        self._check(offset)
        return self._is_proved(offset, length)

    def _check(self, offset: int) -> None:
        limit = max(_MIN_PROOF_BYTES, _MAX_PROOFS * self._file.size_bytes)
        if self._attempts > _MAX_CANDIDATES or self._proof_bytes > limit:
            expected = (
                f"at most {_MAX_CANDIDATES} places that look like a {self._layout.name}, or {limit} bytes of them"
            )
            raise self._file.error(f"byte {offset}", "a damaged file", expected)

    def _is_proved(self, offset: int, length: int) -> bool:
        return self._layout.is_proved(self._reader.peek(offset, length))


def records(
    file: CheckedFile, layout: RecordFormat, first: int, notes: Notes, *, with_content: bool = True
) -> Iterator[tuple[str, int, bytes]]:
    """Yield place, offset and bytes of each complete record from offset `first` on; without content only its head.

    If the data begins otherwise and there is no record, that is the `first_error` of the notes.

    Raises:
        SurveyFileError: The file cannot be read, or has too many places that look like a record.
    """
    reader = SequentialReader(file)
    search = _Search(reader, layout)
    size = file.size_bytes
    offset = first
    found_any = False
    while offset < size:
        length = search.length_at(offset)
        end = offset + length
        whole = length > 0 and end <= size
        after = end
        if not whole or not search.is_sound(offset, length):
            found = search.next_record(offset + 1)
            after = size if found is None else found
            whole = whole and after >= end
        if whole:
            found_any = True
            place = f"{layout.name} at byte {offset}"
            yield place, offset, reader.peek(offset, length if with_content else layout.head_bytes)
        lost_from = end if whole else offset
        if after == size and lost_from < size:
            is_cut = length > 0 and not whole
            _note_end(reader, layout, lost_from, notes, is_cut=is_cut, is_zero=lost_from >= search.zeros_from)
        elif lost_from < after:
            notes.lost(layout.name, lost_from, after)
        offset = after
    start = reader.peek(first, len(layout.magic))
    if not found_any and start != layout.magic[: len(start)]:
        place = f"{layout.name} at byte {first}, marker"
        notes.first_error = notes.first_error or file.error(place, start.hex(), layout.magic.hex())


def _zeros_from(file: CheckedFile) -> int:
    end = file.size_bytes
    while end:
        start = max(end - _SEARCH_BYTES, 0)
        rest = file.read_at(start, end - start, f"byte {start}").rstrip(b"\0")
        if rest:
            return start + len(rest)
        end = start
    return 0


def _note_end(
    reader: SequentialReader, layout: RecordFormat, start: int, notes: Notes, *, is_cut: bool, is_zero: bool
) -> None:
    """Note the bytes from `start` up to the end of the file, which contain no whole record."""
    count = reader.file.size_bytes - start
    head = reader.peek(start, layout.head_bytes)
    if is_zero:
        notes.ended(f"the file ends with {count} zero bytes, as after a power failure")
    elif is_cut or (
        head[: len(layout.magic)] == layout.magic[: len(head)] and (layout.magic or len(head) < layout.head_bytes)
    ):
        notes.ended(
            f"the file ends inside its last {layout.name}, as after a power failure: {count} bytes are left out"
        )
    else:
        notes.lost(layout.name, start, reader.file.size_bytes)
