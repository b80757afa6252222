"""Health records of a fleet as `sonarpost status` shows them, and platforms that publish health."""

import io
import threading
from typing import Any

import zenoh
from rich.console import Console

from sonarpost import keys, wire
from sonarpost.cli import status
from sonarpost.messages import Health
from sonarpost.monitoring.fleet import FleetState, ServiceStatus


def health(platform: str = "vessel-1", service: str = "op_modem", **changes: Any) -> Health:
    fields: dict[str, Any] = {
        "platform_id": platform,
        "service": service,
        "time_utc_s": 1476262800.0,
        "started_utc_s": 1476262000.0,
        "state": "ok",
        "counters": {},
        "gauges": {"inbox": 0.0, "outbox": 3.0, "refused": 0.0, "disk_free_bytes": 12.3e9},
    }
    return Health(**(fields | changes))


def seen(record: Health | None, age_s: float | None = 1.2, *, alive: bool | None = True) -> ServiceStatus:
    platform, service = (record.platform_id, record.service) if record else ("vessel-1", "relay")
    return ServiceStatus(platform, service, record, age_s if record else None, alive)


MODEM = health(
    counters={"frames_received": 49, "frames_bad": 1},
    gauges={"inbox": 0.0, "outbox": 3.0, "snr_in_db": 11.5, "modem_ready": 1.0, "disk_free_bytes": 0.5e9},
)
BROKEN = health(
    "uuv-1", "uuv_modem", state="degraded", detail="/dev/ttyUSB0: not open yet", gauges={"modem_ready": 0.0}
)
FLEET = FleetState(
    (
        seen(health("uuv-1", "compressor")),
        seen(BROKEN, 3.0),
        seen(health(service="decompressor"), 200.0),
        seen(MODEM),
        seen(None),
        seen(health("vessel-2", "relay", state="stopping"), 90_000.0, alive=False),
        seen(health("vessel-2", "router"), 4.0, alive=False),
    ),
    connected=True,
    rejected=2,
)


def on_terminal(state: FleetState, width: int = 80) -> list[str]:
    console = Console(file=io.StringIO(), force_terminal=True, width=width, height=40, color_system=None)
    console.print(status.table(state, status.rows_of(state, 15.0), "tcp/127.0.0.1:7447"))
    assert isinstance(console.file, io.StringIO)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


class Platforms:
    """Publishes health and holds liveliness tokens like services."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._records: list[Health] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._publish, daemon=True)
        self._thread.start()

    def run(self, record: Health) -> None:
        key = keys.alive(record.platform_id, record.service)
        self._tokens[key] = self._session.liveliness().declare_token(key)
        self._records.append(record)

    def end(self, record: Health) -> None:
        self._records.remove(record)
        self._tokens.pop(keys.alive(record.platform_id, record.service)).undeclare()

    def _publish(self) -> None:
        while not self._stop.wait(0.05):
            for record in tuple(self._records):
                self._session.put(keys.health(record.platform_id, record.service), wire.encode(record))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
