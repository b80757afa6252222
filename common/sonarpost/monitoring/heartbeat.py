"""Heartbeat file of a service, for supervisors: a container engine, systemd, a script.

The service replaces the file in `SONARPOST_HEARTBEAT` with every health record; `healthcheck` reads it. A check of a
file takes milliseconds, needs no Zenoh session, and does not depend on the router. The file belongs on a memory file
system, so that a full or worn disk does not prevent it.
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
# Counters of finished records; a service makes progress while one of them increases.
_FINISHED = ("records_handled", "records_refused", "records_failed")


class Heartbeat:
    """Writer of the heartbeat file.

    Args:
        environment: Variables of the process; without the file in `SONARPOST_HEARTBEAT` nothing is written.
        state_dir: Folder of the service's store, whose free space is checked.
        interval_s: Interval of the calls of `beat`.
    """

    def __init__(self, environment: Mapping[str, str], state_dir: Path, interval_s: float) -> None:
        name = environment.get(VARIABLE, "")
        self._path = Path(name) if name else None
        self._state_dir = state_dir
        self._interval_s = interval_s
        self._finished = -1
        self._progress_s = 0.0
        self._warned = False

    def beat(self, health: Health, now_s: float) -> None:
        """Write the present state.

        Args:
            health: Health of the service.
            now_s: Time of the monotonic clock, which all processes of a host share.
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
            if not self._warned:
                log.warning("Heartbeat not written", extra=kv(file=self._path, error=str(error)))
            self._warned = True
