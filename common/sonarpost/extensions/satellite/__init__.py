"""Satellite terminals: records in messages of at most 340 bytes, from the relay of a vessel to c2."""
