"""Attacks on the sender of events."""

from builders.hostile_rows import Row

ROWS = (Row(("exchange:extensions.tak.*",), "server", "endless", "tests/extensions/tak/test_command.py"),)
