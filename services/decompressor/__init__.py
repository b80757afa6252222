"""Decompressor: acoustic frames to images."""
