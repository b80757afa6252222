"""Simulated missions of several vehicles on simulated time."""
