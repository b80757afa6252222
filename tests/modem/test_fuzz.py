"""Fuzzed input: the driver raises nothing, keeps its memory bounded and recovers."""

import random

import pytest
from builders.modem_fuzz import INPUT_LINES, check, random_input


@pytest.mark.parametrize("seed", [1, 2])
def test_driver_survives_fuzzed_lines(seed: int) -> None:
    rng = random.Random(seed)
    sentences = [check(random_input(rng)) for _ in range(5)]
    assert INPUT_LINES < sum(sentences) < 5 * INPUT_LINES, "many lines pass the parser, and not all"
