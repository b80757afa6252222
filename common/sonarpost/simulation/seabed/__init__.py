"""Simulated seabeds with objects, and side-scan surveys of them with known truth."""
