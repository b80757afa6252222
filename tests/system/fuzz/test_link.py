"""The checks of `run_atheris.py` on genuine traffic and on a fixed set of damaged inputs."""

import random

import pytest
from builders import modem_fuzz, v1_fuzz

BOTH = pytest.mark.parametrize("fuzzed", [v1_fuzz, modem_fuzz], ids=["receiver", "driver"])


@BOTH
def test_genuine_traffic_passes_and_reaches_the_checks(fuzzed):
    assert sum(map(fuzzed.check, fuzzed.seeds())) > 100


@BOTH
def test_damaged_traffic_passes_the_checks(fuzzed):
    rng, genuine = random.Random(7), list(fuzzed.seeds())
    for _ in range(60):
        data = bytearray(rng.choice(genuine) + rng.choice(genuine))
        for _ in range(rng.randrange(30)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        fuzzed.check(bytes(data[: rng.randrange(len(data))]))
