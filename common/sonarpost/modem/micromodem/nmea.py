r"""NMEA sentences of the Micro-Modem: `$BODY*HH\r\n`, HH being the XOR of the body in upper-case hex.

`parse` reads one line, `format` writes one. `LineAssembler` cuts the byte stream of a serial port into sentences: for
any bytes it returns sentences and `SentenceError` items, raises nothing and stores at most one sentence. `FieldReader`
reads typed fields.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from sonarpost.errors import SentenceError

MAX_SENTENCE_BYTES = 8192
"""Longest accepted line, `$` to checksum: enough for a flexible data packet of 2048 bytes in hex."""

MAX_ADDRESS = 127
"""Highest modem address (`SRC` is 0..127)."""

_EXCERPT_BYTES = 60
_KIND = re.compile(r"[A-Z][A-Z0-9]{2,11}")
_BODY = re.compile(rb"[ -#%-)+-~]*")
_CHECKSUM = re.compile(rb"[0-9A-Fa-f]{2}")
_BOUNDARY = re.compile(rb"([\r\n$])")
_IGNORED = b"\x00 \t"

_INTEGER = re.compile(r"\s*[+-]?[0-9]{1,18}\s*")
_STRICT_INTEGER = re.compile(r"-?[0-9]{1,10}")
_REAL = re.compile(r"[+-]?(?:[0-9]{1,18}(?:\.[0-9]{0,18})?|\.[0-9]{1,18})(?:[eE][+-]?[0-9]{1,3})?")
_HEX = re.compile(r"(?:[0-9A-Fa-f]{2})*")


@dataclass(frozen=True, slots=True)
class Sentence:
    """One sentence without its framing.

    Attributes:
        kind: Talker and type, for example "CCCYC".
        fields: The comma-separated fields after it, as text; an empty field is an empty string.
    """

    kind: str
    fields: tuple[str, ...] = ()

    def encode(self) -> bytes:
        """Return the bytes on the serial line, with checksum and line end."""
        return format(self.kind, *self.fields)


def is_text(data: bytes) -> bool:
    """Return whether bytes can be a field as they are: printable ASCII without `$` and `*`."""
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
        SentenceError: A kind that is not capitals and digits, a field with `$`, `*`, `,` or a character that is not
            printable ASCII, or a sentence longer than `MAX_SENTENCE_BYTES`.
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
        checksum_required: Reject a line without a checksum (its end may be lost).

    Raises:
        SentenceError: No leading `$`, invalid characters, a wrong or incomplete checksum, an invalid kind, or a line
            longer than `MAX_SENTENCE_BYTES`.
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
        raise SentenceError(where, "checksum", _excerpt(text), "*HH at the end of the line")
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

    A line ends at CR, LF, or the `$` of the next line: a line without its line end is accepted if its checksum is
    complete and correct. Each run of bytes between sentences is one `SentenceError`, except NULs and blanks, which a
    port returns when a modem powers up. A line longer than `MAX_SENTENCE_BYTES` is one `SentenceError`; parsing
    continues at the next `$`.

    Args:
        where: Names the port in errors.
        learn_checksums: After the first line with a checksum, reject lines without: a damaged `*` hides other damage.
    """

    def __init__(self, where: str = "modem port", *, learn_checksums: bool = False) -> None:
        self._where = where
        self._learn_checksums = learn_checksums
        self._checksums_seen = False
        self._line = bytearray()
        self._length = 0

    @property
    def pending_bytes(self) -> int:
        """Number of stored bytes of an unfinished line."""
        return len(self._line)

    def feed(self, data: bytes) -> list[Sentence | SentenceError]:
        """Add the next bytes; return the items they complete, in order."""
        items: list[Sentence | SentenceError] = []
        for part in _BOUNDARY.split(data):
            if part == b"$":
                self._finish_line(items, cut_off=True)
                self._append(part)
            elif part in {b"\r", b"\n"}:
                self._finish_line(items, cut_off=False)
            else:
                self._append(part)
        return items

    def reset(self) -> None:
        """Delete the unfinished line, and accept lines without a checksum again: the port was closed."""
        self._checksums_seen = False
        self._line.clear()
        self._length = 0

    def _append(self, part: bytes) -> None:
        # Beyond the limit only the length is counted; of noise only the excerpt for the error is stored.
        in_sentence = part == b"$" or self._line.startswith(b"$")
        limit = MAX_SENTENCE_BYTES if in_sentence else _EXCERPT_BYTES
        if not in_sentence and not self._length:
            part = part.lstrip(_IGNORED)
        self._length += len(part)
        self._line += part[: max(0, limit - len(self._line))]

    def _finish_line(self, items: list[Sentence | SentenceError], *, cut_off: bool) -> None:
        line, length = bytes(self._line), self._length
        self._line.clear()
        self._length = 0
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


class FieldReader:
    """Reads typed fields of one sentence, by their index from 0.

    Args:
        sentence: The sentence.
        kinds: Accepted kinds; any when empty.
        at_least: Required number of fields.
        strict: Reject missing fields, and integers with blanks or a plus sign. The driver reads sentences of modems
            with tolerance; the emulator reads those of hosts strictly.

    Raises:
        SentenceError: Another kind, or too few fields. The methods raise it for a field of another type or range.
    """

    def __init__(
        self, sentence: Sentence, kinds: tuple[str, ...] = (), at_least: int = 0, *, strict: bool = False
    ) -> None:
        if kinds and sentence.kind not in kinds:
            raise SentenceError("sentence", "kind", sentence.kind, " or ".join(kinds))
        if len(sentence.fields) < at_least:
            raise SentenceError(sentence.kind, "fields", len(sentence.fields), f"at least {at_least}")
        self._where = sentence.kind
        self._fields = sentence.fields
        self._strict = strict

    def text(self, index: int, name: str = "") -> str:
        """Return a field unchanged; a missing one is empty, or an error when reading strictly."""
        if index < len(self._fields):
            return self._fields[index]
        if self._strict:
            raise SentenceError(self._where, name, ",".join(self._fields), f"at least {index + 1} fields")
        return ""

    def name(self, index: int, name: str) -> str:
        """Return a field that must not be empty."""
        text = self.text(index, name)
        if not text:
            raise SentenceError(self._where, name, text, "a value")
        return text

    def integer(self, index: int, name: str, low: int, high: int) -> int:
        """Return a field as an integer in low..high; leading zeros are accepted."""
        text = self.text(index, name)
        pattern = _STRICT_INTEGER if self._strict else _INTEGER
        if not pattern.fullmatch(text) or not low <= int(text) <= high:
            raise SentenceError(self._where, name, text, f"an integer in {low}..{high}")
        return int(text)

    def optional_integer(self, index: int, name: str, low: int = -(2**31), high: int = 2**31) -> int | None:
        """Return an integer, or None for an empty or missing field."""
        return self.integer(index, name, low, high) if self.text(index, name).strip() else None

    def optional_real(self, index: int, name: str) -> float | None:
        """Return a finite number, or None for an empty or missing field."""
        text = self.text(index, name).strip()
        if not text:
            return None
        if not _REAL.fullmatch(text) or not math.isfinite(float(text)):
            raise SentenceError(self._where, name, text, "a finite decimal number")
        return float(text)

    def address(self, index: int, name: str) -> int:
        """Return a modem address, 0..127."""
        return self.integer(index, name, 0, MAX_ADDRESS)

    def flag(self, index: int, name: str) -> bool:
        """Return a 0 or 1 as a bool."""
        return self.integer(index, name, 0, 1) == 1

    def data(self, index: int, name: str) -> bytes:
        """Return pairs of hex digits as bytes, possibly none."""
        text = self.text(index, name)
        if not _HEX.fullmatch(text):
            raise SentenceError(self._where, name, text, "pairs of hex digits")
        return bytes.fromhex(text)


def _excerpt(data: bytes) -> str:
    return data[:_EXCERPT_BYTES].decode("ascii", "backslashreplace")
