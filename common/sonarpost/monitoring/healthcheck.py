"""`python -m sonarpost.monitoring.healthcheck`: tells whether the service that writes the heartbeat file is well.

Exit status 0 when it is, 1 with the reason on standard output when it is not:

- no heartbeat: the service has not started, because its router is not reached for example;
- an old heartbeat: the process hangs;
- degraded: the service says that something keeps it from its work (it cannot store, its modem does not answer);
- stalled: records wait and for a long time none was finished;
- no room: the disk of its store is full.

Nothing heavy is imported: a container engine runs this every few seconds for every service.
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
# A picture of 8 kB takes seven minutes at rate 1; half an hour without anything finished is no picture.
STALLED_AFTER_S = 1800.0
# Missed beats until a service counts as hanging, and the least time for that on a busy machine.
MISSED_BEATS = 3
HANGS_AFTER_S = 15.0
# A store commits into its write-ahead log: with less than this the next record may not fit.
MIN_FREE_BYTES = 1 << 20


def health_problem(path: Path, now_s: float, stalled_after_s: float = STALLED_AFTER_S) -> str:
    """Return what is wrong with the service, an empty text when nothing is.

    Args:
        path: Its heartbeat file.
        now_s: Seconds of the monotonic clock.
        stalled_after_s: Longest time without a finished record while some wait.
    """
    try:
        beat = json.loads(path.read_bytes())
        age_s = now_s - float(beat["beat_monotonic_s"])
        allowed_s = max(HANGS_AFTER_S, MISSED_BEATS * float(beat["interval_s"]))
        state, detail, folder = str(beat["state"]), str(beat["detail"]), Path(str(beat["state_dir"]))
        waiting, stalled_s = int(beat["waiting"]), float(beat["stalled_s"])
    except FileNotFoundError:
        return f"no heartbeat at {path}: the service has not started (is its router reached?)"
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"{path}: got {type(error).__name__}: {error}, expected a heartbeat file"
    if age_s > allowed_s:
        return f"hangs: last heartbeat {age_s:.0f} s ago, expected within {allowed_s:.0f} s"
    if state != "ok":
        return f"{state}: {detail}" if detail else state
    if waiting and stalled_s > stalled_after_s:
        return f"stalled: {waiting} records wait and none was finished for {stalled_s:.0f} s"
    return _no_room(folder)


def _no_room(folder: Path) -> str:
    try:
        room = os.statvfs(folder)
    except OSError as error:
        return f"{folder}: {error.strerror or error}"
    free = room.f_bavail * room.f_frsize
    return "" if free >= MIN_FREE_BYTES else f"{folder}: {free} B free, expected at least {MIN_FREE_BYTES} B"


def check(environment: Mapping[str, str], now_s: float) -> tuple[int, str]:
    """Return the exit status and the line to print."""
    name = environment.get(VARIABLE, "")
    if not name:
        return 1, f"{VARIABLE} is not set, expected the service's heartbeat file"
    text = environment.get(STALLED_VARIABLE, "") or str(STALLED_AFTER_S)
    try:
        stalled_after_s = float(text)
    except ValueError:
        return 1, f"{STALLED_VARIABLE}: got {text!r}, expected seconds"
    reason = health_problem(Path(name), now_s, stalled_after_s)
    return (1, reason) if reason else (0, "well")


def main() -> int:
    """Check, print and return the exit status."""
    status, line = check(os.environ, time.monotonic())
    print(line)
    return status


if __name__ == "__main__":
    sys.exit(main())
