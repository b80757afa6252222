"""Run a module with a shifted clock: `python shifted_clock.py OFFSET_FILE MODULE ARGUMENTS…`.

`time.time` and `time.time_ns` are shifted by the number of seconds in the file at that moment. The monotonic clock is
not affected, as if the system clock were set.
"""

import runpy
import sys
import time
from pathlib import Path

_FILE = Path(sys.argv[1])
_TIME, _TIME_NS = time.time, time.time_ns


def offset_s() -> float:
    """Return the present offset; the file is replaced atomically."""
    return float(_FILE.read_text())


time.time = lambda: _TIME() + offset_s()
time.time_ns = lambda: _TIME_NS() + int(offset_s() * 1e9)

if __name__ == "__main__":
    sys.argv = sys.argv[2:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
