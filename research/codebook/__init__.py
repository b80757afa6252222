"""Builds, compares and adapts tile codebooks: `python -m research.codebook`."""
