"""Fixtures of these tests; `builders.services` makes them."""

from builders.services import runner, short_retry_delays, texture

__all__ = ["runner", "short_retry_delays", "texture"]
