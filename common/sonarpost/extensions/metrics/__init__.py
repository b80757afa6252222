"""Health of all platforms at a router, for Prometheus."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

METRICS: Final = CommandSpec(
    "serve the health of all platforms to Prometheus",
    "sonarpost.extensions.metrics.command:add_options",
    "--router tcp/127.0.0.1:7447 --port 9464",
)
