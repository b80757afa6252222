"""Alerts about contacts, to a webhook or an MQTT broker."""

from typing import Final

from sonarpost.cli.parsing.commands import AddedCommand

ALERT: Final = AddedCommand(
    "send an alert for each contact above a threshold",
    "sonarpost.extensions.alerts.command:add_parser",
    {"c2 alert": "c2 alert --webhook https://hooks.example/mines --threshold 0.7 --state alerts.db --archive out"},
    {"paho": "mqtt"},
)
