"""Georeferenced images of recordings: track, canvas, waterfalls of lines, GeoTIFF files."""
