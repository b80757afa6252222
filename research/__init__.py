"""Benchmarks, training and reproduction of the paper: run from the repository root as `python -m research.NAME`."""
