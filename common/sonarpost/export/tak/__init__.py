"""TAK: Cursor-on-Target events, their delivery to servers, and data packages with images."""
