"""Fuzzed input: the driver raises nothing, keeps its memory bounded and recovers."""

import pytest
from builders.modem_fuzz import Fuzz, parse_alone


@pytest.mark.parametrize("seed", [1, 2])
def test_driver_survives_fuzzed_lines(seed: int) -> None:
    fuzz = Fuzz(seed)
    fuzz.run(2000)
    assert fuzz.sentences_parsed > 1000, "most lines must pass the parser to test the driver"
    assert 250 < parse_alone([fuzz.line() for _ in range(1000)]) < 1000
