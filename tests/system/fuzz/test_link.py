"""The checks of `run_atheris.py` on genuine traffic and on a fixed set of damaged inputs."""

import random

import pytest
from builders.link_oracle import CHECKS, seeds


@pytest.mark.parametrize("name", CHECKS)
def test_genuine_traffic_passes_and_reaches_the_checks(name):
    assert sum(CHECKS[name](seed) for seed in seeds(name)) > 100


@pytest.mark.parametrize("name", CHECKS)
def test_damaged_traffic_passes_the_checks(name):
    rng, genuine = random.Random(7), list(seeds(name))
    for _ in range(60):
        data = bytearray(rng.choice(genuine) + rng.choice(genuine))
        for _ in range(rng.randrange(30)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        CHECKS[name](bytes(data[: rng.randrange(len(data))]))
