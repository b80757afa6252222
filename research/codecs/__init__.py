"""Quality, size and speed of the codecs."""
