"""Print the table of all configurations and removed rules."""

from __future__ import annotations

import sys

from builders.delivery_model.rules import NEW, OLD
from builders.delivery_model.scenarios import LARGE_SCENARIOS, REMOVALS, SCENARIOS, hostile, restore
from builders.delivery_model.search import Result, explore


def _print(name: str, result: Result) -> None:
    sys.stdout.write(f"{name}: {result}\n")
    sys.stdout.flush()


for world in (hostile(OLD), restore(OLD)):
    _print("identity by origin and number only", explore(world, "I1"))
for scenario in (*SCENARIOS, *LARGE_SCENARIOS):
    _print(scenario.__name__, explore(scenario(NEW)))
for removal in REMOVALS:
    _print(removal.name, explore(removal.world, removal.invariant))
