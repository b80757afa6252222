"""Training: a console with simulated contacts, and known objects among the contacts of a watch."""

from typing import Final

from sonarpost.cli.parsing.commands import AddedCommand

TRAINING: Final = AddedCommand(
    "serve simulated contacts for training",
    "sonarpost.extensions.training.command:add_parser",
    {"console training": "console training 40"},
)
