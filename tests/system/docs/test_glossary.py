"""The first use of each term on a page of the documentation is a link to the glossary."""

from __future__ import annotations

import re

import glossary
import pytest
from builders.common import REPOSITORY

TEXT = (REPOSITORY / "docs" / glossary.PAGE).read_text(encoding="utf-8")
TERMS = glossary.anchors(TEXT)


def linked(markdown: str) -> str:
    return glossary.with_links(markdown, TERMS, "g.md")


@pytest.mark.parametrize(
    "term",
    [
        *("rate", "frame", "half", "snippet", "preview", "tile", "version", "join", "group"),
        *("C2", "ATD", "MLO", "TAK", "SPIHT", "packet", "budget", "side-car", "detail"),
    ],
)
def test_words_of_a_first_hour_are_explained(term: str) -> None:
    [row] = re.findall(rf"^\| (?:[^|]+, )?{re.escape(term)}(?:, [^|]+)? \| (.+) \|$", TEXT, re.MULTILINE)
    assert len(row) > 15
    assert f'<span id="{TERMS[term]}">{term}</span>' in glossary.with_anchors(TEXT)


def test_anchors_are_unique_and_terms_sorted() -> None:
    assert len(set(TERMS.values())) == len(TERMS)
    for section in TEXT.split("\n## ")[1:]:
        terms = [t.strip() for t in re.findall(r"^\| (?!term|--)([^|,]+)", section, re.MULTILINE)]
        assert terms == sorted(terms, key=str.lower)


def test_only_the_first_use_is_a_link() -> None:
    assert linked("A frame and Frames. ATD.") == (
        "A [frame](g.md#frame){ .term } and Frames. [ATD](g.md#atd){ .term }."
    )
    assert linked("Codebooks hold tiles") == "[Codebooks](g.md#codebook){ .term } hold [tiles](g.md#tile){ .term }"


@pytest.mark.parametrize(
    "text",
    [
        "# A frame",
        "`frame`",
        "```sh\nframe\n```",
        "[a frame](other.md)",
        "[a\nframe](other.md)",
        "![frame](frame.png)",
        "<!-- a frame -->",
        '<img alt="frame" src="x">',
        "| frame | packet |\n|---|---|",
        "frame-based, frames/s, /frame, frame.toml, frameless",
        "half an hour, a version of Python, a group of users, port 80 and map tiles",
        "the atd of a mac",
    ],
)
def test_code_headings_links_and_other_meanings_are_left_alone(text: str) -> None:
    assert linked(text) == text


def test_longer_terms_come_first_and_words_may_be_on_two_lines() -> None:
    assert linked("the embedded\nstream of a stream") == (
        "the [embedded\nstream](g.md#embedded-stream){ .term } of a [stream](g.md#stream){ .term }"
    )


@pytest.mark.parametrize(
    ("text", "term"),
    [("at rate 4", "rate"), ("the missing half", "half"), ("coding groups", "group"), ("of image versions", "version")],
)
def test_everyday_words_are_linked_in_their_context(text: str, term: str) -> None:
    assert f"](g.md#{term}){{ .term }}" in linked(text)


def test_every_page_of_a_newcomer_links_its_terms() -> None:
    for page, terms in (
        ("README.md", {"contact", "survey", "frame", "preview", "spiht"}),
        ("docs/quick-start.md", {"contact", "frame", "rate", "snippet"}),
        ("docs/explanation/acoustic-link.md", {"erasure-code", "preview", "packet", "symbol"}),
    ):
        found = re.findall(r"\]\(g\.md#([\w-]+)\)\{ \.term \}", linked((REPOSITORY / page).read_text(encoding="utf-8")))
        assert terms <= set(found), page
        assert len(found) == len(set(found)), page
