"""Attacks on the alerts; see `builders.hostile_rows`."""

from builders.hostile_rows import Row

ROWS = (Row(("exchange:extensions.alerts.senders",), "vessel", "endless", "tests/extensions/alerts/test_attacks.py"),)
