"""Training: a console with simulated contacts, and known objects among the contacts of a watch."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

TRAINING: Final = CommandSpec(
    "serve simulated contacts for training",
    "sonarpost.extensions.training.command:add_options",
    "40",
)
