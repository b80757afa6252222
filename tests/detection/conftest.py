"""Fixtures of these tests; `builders.speckle_survey` makes them."""

from __future__ import annotations

from builders.speckle_survey import make_survey

__all__ = ["make_survey"]
