"""The check of the fuzzer for survey readers, on a fixed set of damaged recordings of every format."""

from collections import Counter

import numpy as np
from builders.survey_oracle import Readers


def test_damaged_recordings_are_rejected_or_read(tmp_path):
    readers = Readers(tmp_path)
    rng = np.random.default_rng(11)
    results: Counter[str] = Counter()
    for seed in readers.seeds():
        assert readers.check(seed) == "read"
        for number in range(60):
            data = bytearray(seed)
            first, last = sorted(rng.integers(1, len(data) + 1, 2).tolist())
            match number % 5:
                case 0:
                    del data[first:]
                case 1:
                    data[min(first, len(data) - 1)] = int(rng.choice((0, 1, 0x7F, 0x80, 0xFF)))
                case 2:
                    data[first : first + 8] = rng.integers(0, 256, 8, dtype=np.uint8).tobytes()
                case 3:
                    del data[first:last]
                case _:
                    data[first:first] = data[first:last]
            results[readers.check(bytes(data))] += 1
    assert min(results["rejected"], results["read"]) > 50, results
