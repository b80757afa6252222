"""`python -m sonarpost.monitoring.healthcheck`: check of the service that writes the heartbeat file.

Exit status 0 if it is healthy, else 1 with the reason on standard output:

- no heartbeat: the service has not started;
- an old heartbeat: the process hangs;
- degraded: the service reports that it cannot work (it waits for its router, its modem does not reply);
- stalled: records wait and none was finished for a long time;
- the disk of its store is full.

The module has no heavy imports: a container engine runs it every few seconds for every service.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path

VARIABLE = "SONARPOST_HEARTBEAT"
STALLED_VARIABLE = "SONARPOST_STALLED_AFTER_S"
# An image of 8 kB takes seven minutes at rate 1, so half an hour without progress is a stall.
STALLED_AFTER_S = 1800.0
# Missed heartbeats after which a service counts as hanging, and the minimum time on a busy machine.
MISSED_BEATS = 3
HANGS_AFTER_S = 15.0
# The store commits to its write-ahead log: with less space the next record can fail.
MIN_FREE_BYTES = 1 << 20


def health_problem(path: Path, now_s: float, stalled_after_s: float = STALLED_AFTER_S) -> str:
    """Return why the service is not healthy, empty if it is.

    Args:
        path: The heartbeat file.
        now_s: Time of the monotonic clock.
        stalled_after_s: Maximum time without a finished record while records wait.
    """
    try:
        beat = json.loads(path.read_bytes())
        age_s = now_s - float(beat["beat_monotonic_s"])
        allowed_s = max(HANGS_AFTER_S, MISSED_BEATS * float(beat["interval_s"]))
        state, detail, folder = str(beat["state"]), str(beat["detail"]), Path(str(beat["state_dir"]))
        waiting, stalled_s = int(beat["waiting"]), float(beat["stalled_s"])
    except FileNotFoundError:
        return f"no heartbeat at {path}: the service has not started"
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"{path}: got {type(error).__name__}: {error}, expected a heartbeat file"
    if age_s > allowed_s:
        return f"hangs: last heartbeat {age_s:.0f} s ago, expected within {allowed_s:.0f} s"
    if state != "ok":
        return f"{state}: {detail}" if detail else state
    if waiting and stalled_s > stalled_after_s:
        return f"stalled: {waiting} records wait and none was finished for {stalled_s:.0f} s"
    return _disk_full(folder)


def _disk_full(folder: Path) -> str:
    try:
        usage = os.statvfs(folder)
    except OSError as error:
        return f"{folder}: {error.strerror or error}"
    free = usage.f_bavail * usage.f_frsize
    return "" if free >= MIN_FREE_BYTES else f"{folder}: {free} B free, expected at least {MIN_FREE_BYTES} B"


def check(environment: Mapping[str, str], now_s: float) -> tuple[int, str]:
    """Return exit status and output line."""
    name = environment.get(VARIABLE, "")
    if not name:
        return 1, f"{VARIABLE} is not set, expected the service's heartbeat file"
    text = environment.get(STALLED_VARIABLE, "") or str(STALLED_AFTER_S)
    try:
        stalled_after_s = float(text)
    except ValueError:
        return 1, f"{STALLED_VARIABLE}: got {text!r}, expected seconds"
    reason = health_problem(Path(name), now_s, stalled_after_s)
    return (1, reason) if reason else (0, "healthy")


def main() -> int:
    """Check, print and return the exit status."""
    status, line = check(os.environ, time.monotonic())
    print(line)
    return status


if __name__ == "__main__":
    sys.exit(main())
