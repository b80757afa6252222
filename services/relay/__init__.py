"""Relay: the vessel to the shore, store and forward."""
