"""The first use of each term on a page of the documentation is a link to the glossary."""

import glossary
import pytest
from builders.common import REPOSITORY

TEXT = (REPOSITORY / "docs" / glossary.PAGE).read_text(encoding="utf-8")
TERMS = glossary.anchors(TEXT)


def linked(markdown):
    return glossary.with_links(markdown, TERMS, "g.md")


def test_anchors_are_unique_and_in_the_page():
    assert len(set(TERMS.values())) == len(TERMS)
    assert '<span id="side-car">side-car</span>' in glossary.with_anchors(TEXT)


@pytest.mark.parametrize(
    ("text", "result"),
    [
        ("A frame and Frames. ATD.", "A [frame](g.md#frame){ .term } and Frames. [ATD](g.md#atd){ .term }."),
        (
            "the embedded\nstream of a stream",
            "the [embedded\nstream](g.md#embedded-stream){ .term } of a [stream](g.md#stream){ .term }",
        ),
        ("at rate 4", "at [rate](g.md#rate){ .term } 4"),
        *(
            (same, same)
            for same in (
                "# A frame",
                "```sh\nframe\n```",
                "[a\nframe](other.md), `frame`, ![frame](frame.png), <!-- a frame -->",
                "| frame | packet |\n|---|---|",
                "frame-based, frames/s, /frame, frame.toml, half an hour, port 80, the atd of a mac",
            )
        ),
    ],
)
def test_first_use_of_a_term_outside_code_headings_and_links_is_a_link(text, result):
    assert linked(text) == result
