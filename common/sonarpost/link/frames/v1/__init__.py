"""Frames, previews, layers, payload objects and feedback of wire format v1."""
