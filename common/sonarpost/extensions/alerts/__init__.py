"""Alerts about contacts, to a webhook or an MQTT broker."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

ALERT: Final = CommandSpec(
    "send an alert for each contact above a threshold to a webhook or an MQTT broker; Ctrl-C ends it",
    "sonarpost.extensions.alerts.command:add_options",
    "--webhook https://hooks.example/mines --threshold 0.7 --state alerts.db --stored",
    {"paho": "mqtt"},
)
