"""A bounded run of what `run_atheris_link.py` runs without end: genuine traffic, and inputs made of it."""

from __future__ import annotations

import random

import pytest
from builders.link_oracle import CHECKS, seeds


@pytest.mark.parametrize("name", CHECKS)
def test_genuine_traffic_reaches_what_is_checked(name: str) -> None:
    assert sum(CHECKS[name](seed) for seed in seeds(name)) > 100


@pytest.mark.parametrize("name", CHECKS)
def test_whatever_comes_of_damaged_inputs_holds(name: str) -> None:
    dice, known = random.Random(7), list(seeds(name))
    for _ in range(60):
        data = bytearray(dice.choice(known) + dice.choice(known))
        for _ in range(dice.randrange(30)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        CHECKS[name](bytes(data[: dice.randrange(len(data))]))
