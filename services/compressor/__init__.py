"""Compressor: snippets to codec streams."""
