"""Text of strangers made harmless for the format it goes into."""

from __future__ import annotations

import html
import re
from datetime import UTC, datetime
from typing import Final

REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"

# https://www.w3.org/TR/xml/#charsets: everything that is not a Char of XML 1.0. C1 controls (and DEL) are Chars, but
# discouraged, and no reader shows them.
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\x7e\xa0-\ud7ff\ue000-\ufdcf\ufdf0-\ufffd\U00010000-\U0010ffff]")
_CONTROL: Final = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
# What spreadsheets take for the beginning of a formula, the full-width forms too:
# https://owasp.org/www-community/attacks/CSV_Injection
_FORMULA: Final = (
    "=+-@\N{FULLWIDTH EQUALS SIGN}\N{FULLWIDTH PLUS SIGN}\N{FULLWIDTH HYPHEN-MINUS}\N{FULLWIDTH COMMERCIAL AT}"
)


def xml_text(text: str) -> str:
    """Return `text` with every character that XML 1.0 does not allow replaced by U+FFFD.

    Markup is left as it is: the XML writer escapes it.
    """
    return _NOT_XML.sub(REPLACEMENT, text)


def html_text(text: str) -> str:
    """Return `text` as HTML shows it literally; characters that XML 1.0 does not allow are replaced."""
    return html.escape(xml_text(text), quote=True)


def csv_text(text: str) -> str:
    """Return `text` as a cell that no spreadsheet takes for a formula.

    Control characters and line ends become U+FFFD, so that a row is a line. A cell that begins like a formula (white
    space in front of it counts as nothing) gets an apostrophe before it.
    """
    cell = _CONTROL.sub(REPLACEMENT, text)
    return f"'{cell}" if cell.lstrip().startswith(tuple(_FORMULA)) else cell


def utc_text(time_utc_s: float) -> str:
    """Return 2016-10-12T09:00:01.250Z."""
    return datetime.fromtimestamp(time_utc_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
