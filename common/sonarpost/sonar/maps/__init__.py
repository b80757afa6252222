"""Maps of recordings: mosaic, waterfalls of lines, covered seabed, GeoTIFF files."""
