"""Escaping of untrusted text for XML, HTML and CSV, and the text form of times and probabilities."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Final

from sonarpost.review.decisions import ReviewState

VERDICT_WORDS: Final[Mapping[ReviewState, str]] = {
    "unreviewed": "unreviewed",
    "mine_like": "mine-like",
    "not_mine_like": "not mine-like",
    "unsure": "unsure",
    "disputed": "disputed",
}

REPLACEMENT: Final = "\N{REPLACEMENT CHARACTER}"

# All characters that are not a Char of XML 1.0 (https://www.w3.org/TR/xml/#charsets), and the discouraged C1 controls
# and DEL.
_NOT_XML: Final = re.compile("[^\t\n\r\x20-\x7e\xa0-\ud7ff\ue000-\ufdcf\ufdf0-\ufffd\U00010000-\U0010ffff]")
_CONTROL: Final = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
# Characters that start a formula in spreadsheet programs, with their full-width forms:
# https://owasp.org/www-community/attacks/CSV_Injection
_FORMULA: Final = (
    "=+-@\N{FULLWIDTH EQUALS SIGN}\N{FULLWIDTH PLUS SIGN}\N{FULLWIDTH HYPHEN-MINUS}\N{FULLWIDTH COMMERCIAL AT}"
)


def xml_text(text: str) -> str:
    """Replace every character that XML 1.0 does not allow by U+FFFD. Markup is not escaped."""
    return _NOT_XML.sub(REPLACEMENT, text)


def html_text(text: str) -> str:
    """Escape text for HTML, and replace characters that XML 1.0 does not allow."""
    return html.escape(xml_text(text), quote=True)


def csv_text(text: str) -> str:
    """Escape text for a CSV cell, so that no spreadsheet program evaluates it as a formula.

    Control characters and line ends become U+FFFD. A cell that starts like a formula, with or without white space
    before it, gets an apostrophe in front.
    """
    cell = _CONTROL.sub(REPLACEMENT, text)
    return f"'{cell}" if cell.lstrip().startswith(tuple(_FORMULA)) else cell


def class_text(atd_class: str) -> str:
    """Return the detector's class as text for people."""
    return "mine-like" if atd_class == "mine_like" else atd_class


def probabilities_text(p_mine_like: float | None, p_other_object: float | None) -> str:
    """Return the probabilities of a contact as whole percentages that add up to 100; empty if they are not known.

    Args:
        p_mine_like: Probability of a mine-like object, 0 to 1.
        p_other_object: Probability of another object, 0 to 1 - `p_mine_like`.

    >>> probabilities_text(0.83, 0.12)
    'mine-like 83 %, other object 12 %, seabed 5 %'
    """
    if p_mine_like is None or p_other_object is None:
        return ""
    mine_like = round(100 * p_mine_like)
    other_object = min(round(100 * p_other_object), 100 - mine_like)
    return f"mine-like {mine_like} %, other object {other_object} %, seabed {100 - mine_like - other_object} %"


def utc_text(time_utc_s: float) -> str:
    """Return a time as ISO 8601, for example 2016-10-12T09:00:01.250Z."""
    return datetime.fromtimestamp(time_utc_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
