"""Exchanges with servers and clients outside, within limits of time, number and size."""
