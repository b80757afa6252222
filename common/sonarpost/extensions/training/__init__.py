"""Training: a console with simulated contacts, and known objects among the contacts of a watch."""

from typing import Final

from sonarpost.cli.parsing.commands import Command

TRAINING: Final = Command(
    "serve simulated contacts for training",
    "sonarpost.extensions.training.command:add_parser",
    {"console training": "console training 40"},
)
