"""Fixtures of these tests; `builders.chain` makes them."""

from builders.chain import start_chain

__all__ = ["start_chain"]
