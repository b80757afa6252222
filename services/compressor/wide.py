"""More of the seabed around a contact."""

from __future__ import annotations

from typing import Final

from sonarpost.messages import Snippet

TIMES: Final = 2
"""How much larger on the ground the pixels of `Snippet.wide` are than those of `Snippet.picture`."""
_LARGEST_PIXEL_M: Final = 100.0


def wider(snippet: Snippet) -> Snippet | None:
    """Return a snippet of the same contact whose picture is the wide one; None where there is none."""
    if snippet.wide is None:
        return None
    contact = snippet.contact
    sizes = {
        "pixel_along_m": _larger(contact.pixel_along_m),
        "pixel_across_m": _larger(contact.pixel_across_m),
    }
    return Snippet(contact=contact.model_copy(update=sizes), picture=snippet.wide, source=snippet.source)


def _larger(pixel_m: float | None) -> float | None:
    """Return the size of the wide picture's pixels, None where that is not known or beyond what a record holds."""
    if pixel_m is None or TIMES * pixel_m > _LARGEST_PIXEL_M:
        return None
    return TIMES * pixel_m
