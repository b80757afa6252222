"""Attacks on the page of a recording, which has the web server of the console."""

from builders.hostile_rows import Row

ROWS = (Row(("port:extensions.survey_view.command",), "client", "slow", "tests/services/console/test_connections.py"),)
