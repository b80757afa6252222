"""Simulation of what sonarpost needs at sea: modems, the acoustic channel, and side-scan surveys of the seabed."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

DEMO: Final = CommandSpec(
    "run the whole chain on this host, from a survey file to the shore",
    "sonarpost.extensions.simulation.demo.command:add_options",
    "--loss 0.3 --seed 3",
)
SIMULATE: Final = CommandSpec(
    "write a simulated side-scan survey as XTF",
    "sonarpost.extensions.simulation.simulate:add_options",
    "line.xtf --seabed ripples --truth truth.json",
)
MODEM_EMULATOR: Final = CommandSpec(
    "emulated acoustic modems on pseudo-terminals or TCP ports",
    "sonarpost.extensions.simulation.modem_emulator:add_options",
    "--modems 2 --tcp --loss 0.1",
)
