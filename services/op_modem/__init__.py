"""The vessel side of the acoustic link."""
