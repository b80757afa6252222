"""Simulation of what sonarpost needs at sea: modems, the acoustic channel, and side-scan surveys of the seabed."""

from __future__ import annotations

from typing import Final

from sonarpost.cli.parsing.commands import AddedCommand

DEMO: Final = AddedCommand(
    "run the whole chain on this host, from a survey file to the shore",
    "sonarpost.extensions.simulation.demo.command:add_parser",
    {"demo": "demo --loss 0.3 --seed 3"},
)
SIMULATE: Final = AddedCommand(
    "write a simulated side-scan survey as XTF",
    "sonarpost.extensions.simulation.simulate:add_parser",
    {"simulate": "simulate line.xtf --seabed ripples --truth truth.json"},
)
MODEM_EMULATOR: Final = AddedCommand(
    "emulated acoustic modems on pseudo-terminals or TCP ports",
    "sonarpost.extensions.simulation.modem_emulator:add_parser",
    {"modem-emulator": "modem-emulator --modems 2 --tcp --loss 0.1"},
)
