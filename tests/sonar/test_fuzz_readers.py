"""The check of the fuzzer for survey readers, on a fixed set of damaged recordings."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np
from builders.survey_oracle import Readers

MAX_CPU_S = 2.0
"""Maximum processor time for reading one of these small files."""


def test_damaged_recordings_are_rejected_or_read_in_bounded_time(tmp_path):
    readers = Readers(tmp_path)
    rng = np.random.default_rng(11)
    results: Counter[str] = Counter()
    slowest_s = 0.0
    for seed in readers.seeds():
        assert readers.check(seed) == "read"
        for number in range(120):
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
            start_s = time.process_time()
            results[readers.check(bytes(data))] += 1
            slowest_s = max(slowest_s, time.process_time() - start_s)
    assert slowest_s < MAX_CPU_S
    assert min(results["rejected"], results["read"]) > 50, results
