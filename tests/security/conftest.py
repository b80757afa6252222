"""Fixtures, defined in `builders.fleet_certificates`."""

from __future__ import annotations

from builders.fleet_certificates import shore_session, vessel_session, world

__all__ = ["shore_session", "vessel_session", "world"]
