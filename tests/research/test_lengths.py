"""Measured lengths of simulated objects against their stated standard deviation."""

import pytest

from research.lengths import BYTES, known_objects, main, measure, summarise


@pytest.fixture(scope="module")
def results():
    return measure(known_objects(20, seed=5), BYTES, seed=5)


def test_stated_sigma_covers_the_error_of_a_length(results):
    # 60 lines of 20 objects. The limits are those of 200 objects, widened by two standard errors of 20 objects.
    lengths = summarise([one for one in results if one.quantity == "length"])
    assert lengths.count == 60
    assert 0.50 <= lengths.within_1 <= 0.86
    assert lengths.within_2 >= 0.85
    assert abs(lengths.bias) <= 0.09
    assert lengths.snapped > 0.9


def test_command_prints_a_row_for_each_number_of_bytes(capsys):
    assert main(["--objects", "1"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[1] for row in rows if row[0] == "length" and row[2] == "both"] == [str(size) for size in BYTES]
