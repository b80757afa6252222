"""Typed reading of a sentence's fields: each has its type and range, or a `SentenceError` names it."""

from __future__ import annotations

import math
import re

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem.nmea import Sentence

MAX_ADDRESS = 127
"""Highest modem address (`SRC` is 0..127)."""

_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
_REAL = re.compile(r"[+-]?(?:[0-9]{1,18}(?:\.[0-9]{0,18})?|\.[0-9]{1,18})(?:[eE][+-]?[0-9]{1,3})?")
_HEX = re.compile(r"(?:[0-9A-Fa-f]{2})*")


class FieldReader:
    """Reads one sentence's fields by their index from 0.

    Args:
        sentence: What was received.
        kinds: The kinds it may have.
        at_least: How many fields it must have.

    Raises:
        SentenceError: Another kind, or too few fields.
    """

    def __init__(self, sentence: Sentence, kinds: tuple[str, ...], at_least: int) -> None:
        if sentence.kind not in kinds:
            raise SentenceError("sentence", "kind", sentence.kind, " or ".join(kinds))
        if len(sentence.fields) < at_least:
            raise SentenceError(sentence.kind, "fields", len(sentence.fields), f"at least {at_least}")
        self._where = sentence.kind
        self._fields = sentence.fields

    def text(self, index: int) -> str:
        """Return a field as it stands; a missing one is empty."""
        return self._fields[index] if index < len(self._fields) else ""

    def name(self, index: int, name: str) -> str:
        """Return a field that must not be empty."""
        text = self.text(index)
        if not text:
            raise SentenceError(self._where, name, text, "a value")
        return text

    def integer(self, index: int, name: str, low: int, high: int) -> int:
        """Return a field as an integer in low..high; leading zeros are usual."""
        text = self.text(index).strip()
        if not _INTEGER.fullmatch(text) or not low <= int(text) <= high:
            raise SentenceError(self._where, name, text, f"an integer in {low}..{high}")
        return int(text)

    def optional_integer(self, index: int, name: str, low: int, high: int) -> int | None:
        """Return an integer, or None where the field is empty or missing."""
        return self.integer(index, name, low, high) if self.text(index).strip() else None

    def optional_real(self, index: int, name: str) -> float | None:
        """Return a finite number, or None where the field is empty or missing."""
        text = self.text(index).strip()
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
        """Return hex digits of either case as bytes; empty is no data."""
        text = self.text(index)
        if not _HEX.fullmatch(text):
            raise SentenceError(self._where, name, text, "pairs of hex digits")
        return bytes.fromhex(text)
