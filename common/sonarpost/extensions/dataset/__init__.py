"""Training data: the contacts of a shore site with verdicts of operators, in COCO format."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

DATASET: Final = CommandSpec(
    "training data from the verdicts of operators", "sonarpost.extensions.dataset.command:add_actions"
)
