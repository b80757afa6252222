"""Fixtures of these tests; `builders.compose` makes them."""

from builders.compose import project

__all__ = ["project"]
