"""Fixtures of these tests; `builders.services` makes them."""

from __future__ import annotations

from builders.services import (
    cable,
    crew,
    impatient,
    is_told,
    publish,
    put_file,
    refused,
    sea,
    snippet,
    texture,
    watch,
    xtf,
)

__all__ = [
    "cable",
    "crew",
    "impatient",
    "is_told",
    "publish",
    "put_file",
    "refused",
    "sea",
    "snippet",
    "texture",
    "watch",
    "xtf",
]
