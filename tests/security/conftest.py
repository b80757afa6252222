"""Fixtures of these tests; `builders.fleet_certificates` makes them."""

from __future__ import annotations

from builders.fleet_certificates import aboard, ashore, world

__all__ = ["aboard", "ashore", "world"]
