"""Fixtures of these tests; `builders.console` makes them."""

from __future__ import annotations

from builders.console import cheap_hashes, console, make_console, users_file

__all__ = ["cheap_hashes", "console", "make_console", "users_file"]
