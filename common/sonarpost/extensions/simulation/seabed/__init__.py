"""Simulated side-scan surveys of a seabed with known objects."""
