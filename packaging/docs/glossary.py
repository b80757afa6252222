"""Links from the first use of each term on a page to the glossary; anchors in the glossary."""

import re
from collections.abc import Mapping

PAGE = "reference/glossary.md"
_ROW = re.compile(r"^\| (?!term \||--)(?P<names>[^|]+) \|", re.MULTILINE)
# Text without links to the glossary: code, headings, heads of tables, comments, links, HTML.
_PROTECTED = re.compile(
    r"^```.*?^```$|^    .*?$|^#.*?$|^\|[^\n]*\|\n(?=\| ?--)|<!--.*?-->|`[^`]*`"
    r"|!?\[(?:[^\[\]]|\[[^\]]*\])*\]\([^)]*\)|<[^>]+>",
    re.MULTILINE | re.DOTALL,
)
# Everyday words are terms in some contexts only.
_CONTEXTS: Mapping[str, str] = {
    "block": r"(?<=current )blocks?|(?<=unfinished )blocks?|blocks?(?= of the erasure code)",
    "channel": r"channels?(?= (?:on|of) each side)",
    "command": r"commands?(?= (?:for|to) (?:a|the) vehicle)|(?<=refine )commands?|(?<=the same )command",
    "detail": r"detail(?= of (?:an|the|every|each) image)|(?<=then )detail",
    "grain": r"(?<=with )grain|(?<=and )grain|(?<=\*\*)grain|(?<=synthetic )grain",
    "group": r"(?<=coding )groups?|groups?(?= of images)",
    "half": r"(?<=top )half|(?<=bottom )half|(?<=missing )half|halves(?= of an image)|(?<=image )halves",
    "join": r"joins?(?= of (?:two )?files)|(?<=file )join",
    "look": r"looks(?= at (?:one|the same|a place|an object|the place))",
    "packet": r"(?<!network )(?<!2000 )packets?",
    "ping": r"(?<!ranging )(?<!clock, )pings?",
    "rate": r"(?:modem |Micro-Modem )rates?|rates?(?= [0-6]\b)",
    "record": r"(?<!contact )(?<!contact\n)(?<!contact\n  )records?(?! such)",
    "recording": r"(?<!replays )recordings?",
    "stream": r"(?<!event )streams?(?! of \[?server)",
    "tile": r"(?<!map )(?<!Mercator )(?<!Mercator\n)tiles?",
    "version": r"(?<=image )versions?|versions?(?= of (?:an|each|the|every) image)",
}


def anchors(markdown: str) -> dict[str, str]:
    """Return the anchor of each term in the glossary."""
    names = [name.strip() for row in _ROW.finditer(markdown) for name in row["names"].split(",")]
    return {name: re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-") for name in names}


def with_anchors(markdown: str) -> str:
    """Return the glossary with an anchor at each term."""
    known = anchors(markdown)

    def mark(row: re.Match[str]) -> str:
        names = (name.strip() for name in row["names"].split(","))
        return "| " + ", ".join(f'<span id="{known[name]}">{name}</span>' for name in names) + " |"

    return _ROW.sub(mark, markdown)


def with_links(markdown: str, terms: Mapping[str, str], glossary: str) -> str:
    """Return a page on which the first use of each term is a link.

    Args:
        markdown: The page.
        terms: Anchor of each term.
        glossary: Link to the glossary from this page.
    """
    left = dict(terms)
    parts = re.split(f"({_PROTECTED.pattern})", markdown, flags=_PROTECTED.flags)
    for number in range(0, len(parts), 2):
        parts[number] = _link_terms(parts[number], left, glossary)
    return "".join(parts)


def _link_terms(text: str, left: dict[str, str], glossary: str) -> str:
    """Return a text in which the first use of each term of `left` is a link; remove these terms from `left`."""
    found: list[tuple[int, int, str]] = []
    # The longest first: `replay window` is not a use of `window`.
    for term in sorted(left, key=len, reverse=True):
        match = next(
            (m for m in _pattern(term).finditer(text) if all(m.end() <= a or m.start() >= b for a, b, _ in found)), None
        )
        if match is not None:
            found.append((match.start(), match.end(), left.pop(term)))
    for start, end, anchor in sorted(found, reverse=True):
        text = f"{text[:start]}[{text[start:end]}]({glossary}#{anchor}){{ .term }}{text[end:]}"
    return text


def _pattern(term: str) -> re.Pattern[str]:
    """Return the pattern of a term. Abbreviations have their capitals, except C2; other terms may have a plural."""
    if term in _CONTEXTS:
        return re.compile(rf"(?<![\w/.-])(?:{_CONTEXTS[term]})(?![\w/-]|\.\w)")
    is_abbreviation = term.upper() == term and term != "C2"
    flags = 0 if is_abbreviation else re.IGNORECASE
    words = r"\s+".join(map(re.escape, term.split()))
    return re.compile(rf"(?<![\w/.-]){words}s?(?![\w/-]|\.\w)", flags)
