r"""NMEA sentences as the Micro-Modem speaks them: `$BODY*HH\r\n`, HH the XOR of the body in upper-case hex.

`parse` reads one line, `format` writes one, and `LineAssembler` cuts a byte stream into sentences. The
assembler is what faces the serial port: whatever bytes it is given, it answers with sentences and
`SentenceError` items, raises nothing and keeps at most one sentence in memory.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from sonarpost.errors import SentenceError

MAX_SENTENCE_BYTES = 8192
"""Longest line accepted, `$` to checksum: a flexible data packet of 2048 bytes in hex, with room to spare."""

_EXCERPT_BYTES = 60
_KIND = re.compile(r"[A-Z][A-Z0-9]{2,11}")
_BODY = re.compile(rb"[ -#%-)+-~]*")
_CHECKSUM = re.compile(rb"[0-9A-Fa-f]{2}")
_BOUNDARY = re.compile(rb"([\r\n$])")
_SILENT = b"\x00 \t"


@dataclass(frozen=True, slots=True)
class Sentence:
    """One sentence without its framing.

    Attributes:
        kind: Talker and type, for example "CCCYC".
        fields: What stands between the commas after it, as text; an empty field is an empty string.
    """

    kind: str
    fields: tuple[str, ...] = ()

    def encode(self) -> bytes:
        """Return the sentence as it travels, checksum and line end included."""
        return format(self.kind, *self.fields)


def is_text(data: bytes) -> bool:
    """Return whether bytes can stand in a sentence as they are: printable ASCII without `$` and `*`."""
    return _BODY.fullmatch(data) is not None


def checksum(body: bytes) -> int:
    """Return the XOR of the bytes between `$` and `*`, 0..255."""
    value = 0
    for byte in body:
        value ^= byte
    return value


def format(kind: str, *fields: str | int) -> bytes:  # noqa: A001 - called as nmea.format
    r"""Return `$kind,field,…*HH\r\n`.

    Raises:
        SentenceError: A kind that is not capitals and digits, a field that holds `$`, `*`, `,` or anything
            outside printable ASCII, or a sentence longer than `MAX_SENTENCE_BYTES`.
    """
    if not _KIND.fullmatch(kind):
        raise SentenceError("sentence to send", "kind", kind, "3 to 12 capitals and digits")
    texts = [str(field) for field in fields]
    for number, text in enumerate(texts, start=1):
        if not text.isascii() or "," in text or not _BODY.fullmatch(text.encode("ascii")):
            raise SentenceError(f"{kind} to send", f"field {number}", text, "printable ASCII without $ * ,")
    body = ",".join([kind, *texts]).encode("ascii")
    if len(body) + 4 > MAX_SENTENCE_BYTES:
        raise SentenceError(f"{kind} to send", "length", len(body), f"at most {MAX_SENTENCE_BYTES - 4} bytes")
    return b"$%b*%02X\r\n" % (body, checksum(body))


def parse(line: bytes, where: str = "modem line", *, checksum_required: bool = False) -> Sentence:
    """Parse one line, with or without its line end.

    Args:
        line: `$BODY` or `$BODY*HH`; upper and lower-case checksum digits are accepted.
        where: Names the port in error messages.
        checksum_required: Refuse a line without a checksum (one that may have lost its tail).

    Raises:
        SentenceError: No `$` in front, characters that no sentence has, a wrong or half checksum, no valid
            kind, or longer than `MAX_SENTENCE_BYTES`.
    """
    text = line.rstrip(b"\r\n")
    if len(text) > MAX_SENTENCE_BYTES:
        raise SentenceError(where, "length", len(text), f"at most {MAX_SENTENCE_BYTES} bytes")
    if not text.startswith(b"$"):
        raise SentenceError(where, "", _excerpt(text), "a sentence that starts with $")
    body, star, digits = text[1:].partition(b"*")
    if star and not _CHECKSUM.fullmatch(digits):
        raise SentenceError(where, "checksum", _excerpt(digits), "two hex digits after *")
    if not star and checksum_required:
        raise SentenceError(where, "checksum", _excerpt(text), "*HH at the end of a line that was cut off")
    if star and int(digits, 16) != checksum(body):
        raise SentenceError(where, "checksum", digits.decode("ascii"), f"{checksum(body):02X} for {_excerpt(body)!r}")
    if not _BODY.fullmatch(body):
        raise SentenceError(where, "", _excerpt(text), "printable ASCII without a second $ or *")
    kind, *fields = body.decode("ascii").split(",")
    if not _KIND.fullmatch(kind):
        raise SentenceError(where, "kind", kind, "3 to 12 capitals and digits")
    return Sentence(kind, tuple(fields))


class LineAssembler:
    r"""Cuts a byte stream into sentences, in bounded memory.

    A line ends at CR, LF, or at the `$` of the next one: a line whose end was lost still counts when its
    checksum is there and right. Bytes between sentences are one `SentenceError` a run (NULs and blanks,
    as a port gives when a modem powers up, are none), a line beyond `MAX_SENTENCE_BYTES` is one, and
    reading goes on at the next `$`.

    Args:
        where: Names the port in errors.
        learn_checksums: Once a line has had a checksum, refuse lines without: a damaged `*` hides other damage.
    """

    def __init__(self, where: str = "modem port", *, learn_checksums: bool = False) -> None:
        self._where = where
        self._learn_checksums = learn_checksums
        self._checksums_seen = False
        self._line = bytearray()
        self._length = 0

    @property
    def pending_bytes(self) -> int:
        """How many bytes of an unfinished line are held."""
        return len(self._line)

    def feed(self, data: bytes) -> list[Sentence | SentenceError]:
        """Take the next bytes; return what they complete, in order."""
        items: list[Sentence | SentenceError] = []
        for piece in _BOUNDARY.split(data):
            if piece == b"$":
                self._finish(items, cut_off=True)
                self._hold(piece)
            elif piece in {b"\r", b"\n"}:
                self._finish(items, cut_off=False)
            else:
                self._hold(piece)
        return items

    def reset(self) -> None:
        """Start anew (the port was closed, perhaps in the middle of a line)."""
        self._checksums_seen = False
        self._clear()

    def _clear(self) -> None:
        self._line.clear()
        self._length = 0

    def _hold(self, piece: bytes) -> None:
        # Beyond the limit only the length is kept; noise needs no more than its excerpt.
        in_sentence = piece == b"$" or self._line.startswith(b"$")
        limit = MAX_SENTENCE_BYTES if in_sentence else _EXCERPT_BYTES
        if not in_sentence and not self._length:
            piece = piece.lstrip(_SILENT)
        self._length += len(piece)
        self._line += piece[: max(0, limit - len(self._line))]

    def _finish(self, items: list[Sentence | SentenceError], *, cut_off: bool) -> None:
        line, length = bytes(self._line), self._length
        self._clear()
        if not length:
            return
        if not line.startswith(b"$"):
            items.append(SentenceError(self._where, "", _excerpt(line), f"sentences, not {length} bytes of noise"))
        elif length > len(line):
            expected = f"at most {MAX_SENTENCE_BYTES} bytes a sentence"
            items.append(SentenceError(self._where, f"length of {_excerpt(line[:12])!r}", length, expected))
        else:
            try:
                items.append(parse(line, self._where, checksum_required=cut_off or self._checksums_seen))
                self._checksums_seen = self._learn_checksums and (self._checksums_seen or b"*" in line)
            except SentenceError as error:
                items.append(error)


def _excerpt(data: bytes) -> str:
    return data[:_EXCERPT_BYTES].decode("ascii", "backslashreplace")
