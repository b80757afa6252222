"""Fixtures, defined in `builders.fleet_certificates`."""

from builders.fleet_certificates import own_world, shared_world, shore_session, vessel_session, world

__all__ = ["own_world", "shared_world", "shore_session", "vessel_session", "world"]
