"""Emulated modems in simulated water, for everything that has no sea at hand."""
