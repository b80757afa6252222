"""Erasure code, blocks, redundancy plan and channel capacity."""
