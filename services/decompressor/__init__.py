"""Decompressor: acoustic frames to pictures."""
