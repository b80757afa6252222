"""Fixtures of these tests; `builders.compose` makes them."""

from __future__ import annotations

from builders.compose import project

__all__ = ["project"]
