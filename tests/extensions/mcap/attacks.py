"""Attacks on the recorder; see `builders.hostile_rows`."""

from builders.hostile_rows import Row

ROWS = (Row(("subscriber:extensions.mcap.record",), "vessel", "flood", "tests/extensions/mcap/test_record.py"),)
