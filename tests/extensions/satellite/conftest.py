"""Fixtures of these tests; `builders.services` makes them."""

from __future__ import annotations

from builders.services import runner, short_retry_delays, texture

__all__ = ["runner", "short_retry_delays", "texture"]
