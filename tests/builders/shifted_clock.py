"""Runs a module under a clock that is set: `python shifted_clock.py OFFSET_FILE MODULE ARGUMENTS…`.

`time.time` and `time.time_ns` are shifted by the number of seconds that the file holds at that moment; the monotonic
clock is not, as the system's is not when the clock is set.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path

_FILE = Path(sys.argv[1])
_TIME, _TIME_NS = time.time, time.time_ns


def offset_s() -> float:
    """Return by how much the clock is wrong now; the file is replaced in one step."""
    return float(_FILE.read_text())


time.time = lambda: _TIME() + offset_s()
time.time_ns = lambda: _TIME_NS() + int(offset_s() * 1e9)

if __name__ == "__main__":
    sys.argv = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
