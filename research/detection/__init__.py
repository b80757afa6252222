"""Evaluation of the detector."""
