"""Fixtures of these tests, from `builders.speckle_survey`."""

from builders.speckle_survey import make_survey

__all__ = ["make_survey"]
