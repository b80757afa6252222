"""Image codecs: one interface, one registry, one file a codec."""
