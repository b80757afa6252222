"""A service's sign of life as a small file, for whatever supervises the process: a container engine, systemd, a script.

Where `SONARPOST_HEARTBEAT` names a file, the service replaces it with every health record; `healthcheck` reads it. A
file and not the router is asked, so that a check costs milliseconds, needs no Zenoh session, and does not call a
service ill because its router is. The file belongs on a memory file system: a full or worn disk must not silence it.
"""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path

from sonarpost.files import write_atomically
from sonarpost.logs import kv
from sonarpost.messages import Health

log = logging.getLogger(__name__)

VARIABLE = "SONARPOST_HEARTBEAT"
# What a service has finished with, for better or worse; while one of these grows it is at work.
_FINISHED = ("records_handled", "records_refused", "records_failed")


class Heartbeat:
    """Writes the file.

    Args:
        path: The file; None writes none.
        state_dir: Where the service keeps its store; the check looks whether there is room.
        interval_s: How often `beat` is called.
    """

    def __init__(self, path: Path | None, state_dir: Path, interval_s: float) -> None:
        self._path = path
        self._state_dir = state_dir
        self._interval_s = interval_s
        self._finished = -1
        self._progress_s = 0.0
        self._complained = False

    @classmethod
    def from_environment(cls, environment: Mapping[str, str], state_dir: Path, interval_s: float) -> Heartbeat:
        """Return one that writes to the file that the environment names, if it does."""
        name = environment.get(VARIABLE, "")
        return cls(Path(name) if name else None, state_dir, interval_s)

    def beat(self, health: Health, now_s: float) -> None:
        """Write the state of this moment.

        Args:
            health: The service's health.
            now_s: Seconds of the monotonic clock, which all processes of a host share.
        """
        if self._path is None:
            return
        finished = sum(health.counters.get(name, 0) for name in _FINISHED)
        waiting = int(health.gauges.get("inbox", 0))
        if finished != self._finished or waiting == 0:
            self._finished, self._progress_s = finished, now_s
        content = {
            "service": health.service,
            "state": health.state,
            "detail": health.detail,
            "beat_monotonic_s": now_s,
            "interval_s": self._interval_s,
            "state_dir": os.fspath(self._state_dir.absolute()),
            "waiting": waiting,
            "stalled_s": round(now_s - self._progress_s, 3),
        }
        try:
            write_atomically(self._path, json.dumps(content).encode())
        except OSError as error:
            if not self._complained:
                log.warning("Heartbeat not written", extra=kv(file=self._path, error=str(error)))
            self._complained = True
