"""Print the table of all configurations and removed rules."""

import sys
from dataclasses import replace

from research.delivery_model.rules import OLD
from research.delivery_model.scenarios import HOSTILE, LARGE_SCENARIOS, REMOVALS, RESTORE, SCENARIOS
from research.delivery_model.search import Result, explore


def _print(name: str, result: Result) -> None:
    sys.stdout.write(f"{name}: {result}\n")
    sys.stdout.flush()


for world in (HOSTILE, RESTORE):
    _print("identity by origin and number only", explore(replace(world, rules=OLD), "I1"))
for name, world in (SCENARIOS | LARGE_SCENARIOS).items():
    _print(name, explore(world))
for removal in REMOVALS:
    _print(removal.name, explore(removal.world, removal.invariant))
