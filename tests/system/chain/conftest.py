"""Fixtures of these tests; `builders.chain` makes them."""

from __future__ import annotations

from builders.chain import start_chain

__all__ = ["start_chain"]
