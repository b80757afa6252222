"""Attacks on the server of metrics, whose connections have limits."""

from builders.hostile_rows import Row

ROWS = (Row(("port:extensions.metrics.command",), "client", "slow", "tests/extensions/metrics/test_metrics.py"),)
