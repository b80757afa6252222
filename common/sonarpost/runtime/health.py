"""Health of a service: counters, degraded state, repeated log lines, and the record that is made of them."""

from __future__ import annotations

import logging
import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sonarpost.delivery.disk_reserve import DiskReserve
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.outbox import Outbox
from sonarpost.delivery.transaction import UnitOfWork
from sonarpost.errors import DeliveryError
from sonarpost.logs import IntervalLog, kv
from sonarpost.messages import Health, ServiceState
from sonarpost.monitoring.heartbeat import Heartbeat
from sonarpost.monitoring.service_manager import ServiceManager
from sonarpost.security.tls_files import TlsMonitor

if TYPE_CHECKING:
    from sonarpost.runtime.service import Service

log = logging.getLogger(__name__)

MAX_DETAIL = 2000


def disk_gauges(folder: Path) -> dict[str, float]:
    """Return the free disk space of a folder as a gauge; an empty map if it cannot be determined."""
    try:
        return {"disk_free_bytes": float(shutil.disk_usage(folder).free)}
    except OSError as error:
        log.debug("Free disk space unknown", extra=kv(folder=folder, error=str(error)))
        return {}


class ServiceHealth:
    """Collects the health of one service and reports it to the supervisor. Safe for several threads.

    Attributes:
        router_failure: Why the router is not reached; empty if it is.
        inbox: The inbox, None while there is none.
        outbox: The outbox, None before the session opens.

    Args:
        service: The service; its hooks add gauges, warnings and why it is degraded.
        disk_reserve: Its disk reserve.
        tls: Its TLS files.
    """

    def __init__(self, service: Service[Any], disk_reserve: DiskReserve, tls: TlsMonitor) -> None:
        self._service = service
        self._platform = platform = service.platform
        self._store = service.store
        self._disk_reserve = disk_reserve
        self._tls = tls
        self.started_utc_s = time.time()
        self.router_failure = ""
        self.inbox: Inbox[Any] | None = None
        self.outbox: Outbox | None = None
        self._degraded = ""
        self._counters: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._interval_logs: list[IntervalLog] = []
        self._heartbeat = Heartbeat(os.environ, platform.state_dir, platform.health_interval_s)
        self.manager = ServiceManager(os.environ, platform.health_interval_s)

    def count(self, name: str, by: int = 1) -> None:
        """Increase a counter."""
        with self._lock:
            self._counters[name] += by

    def count_committed(self, handled: Iterable[UnitOfWork]) -> None:
        """Increase the counters by those of committed units of work."""
        with self._lock:
            for effects in handled:
                for name, by in effects.counts.items():
                    self._counters[name] += by

    def interval_log(self, logger: logging.Logger, level: int, message: str) -> IntervalLog:
        """Return a log for a repeated event; see `Service.interval_log`."""
        made = IntervalLog(logger, level, message)
        self._interval_logs.append(made)
        return made

    def flush_logs(self, *, stopping: bool = False) -> None:
        """Log the end of bursts of repeated events."""
        for interval_log in self._interval_logs:
            interval_log.flush(stopping=stopping)

    def set_degraded(self, reason: str) -> None:
        """Report the service as degraded in health and log; an empty reason reports it as recovered."""
        if reason == self._degraded:
            return
        if reason:
            log.error("Service degraded", extra=kv(reason=reason))
        else:
            log.info("Service recovered")
        self._degraded = reason

    def record(self, state: ServiceState | None = None) -> Health:
        """Return the health record of this moment.

        Args:
            state: The state; by default "degraded" or "ok".

        Raises:
            DeliveryError: The store cannot be read.
        """
        now_utc_s = time.time()
        detail = self._detail(now_utc_s)
        restored = "" if self.outbox is None else self.outbox.warning()
        router = f"router not reached: {self.router_failure}" if self.router_failure else ""
        warnings = (self._service.warning(), router, restored, self._tls.warning(now_utc_s))
        with self._lock:
            counters = dict(self._counters)
        if discarded := self._discarded_count():
            counters["states_discarded"] = discarded
        gauges = {
            "inbox": float(self._store.inbox_depth()),
            "outbox": float(self._store.outbox_depth()),
            "refused": float(self._store.refused_count()),
            **disk_gauges(self._platform.state_dir),
            **self._tls.gauges(now_utc_s),
            **self._service.gauges(),
        }
        return Health(
            platform_id=self._platform.id,
            service=self._service.NAME,
            time_utc_s=time.time(),
            started_utc_s=self.started_utc_s,
            state=state or ("degraded" if detail else "ok"),
            detail="; ".join(text for text in (detail, *warnings) if text)[:MAX_DETAIL],
            counters=counters,
            gauges=gauges,
        )

    def _detail(self, now_utc_s: float) -> str:
        """Return why the service is degraded; empty if it is not."""
        detail = self._degraded
        if self.inbox is not None and self.inbox.storage_failing:
            # With the cause, for example a database that is not reached.
            detail = detail or "; ".join(filter(None, ("records cannot be stored", self._service.degraded_reason())))
        return (
            detail
            or self._disk_reserve.degraded_reason()
            or self._service.degraded_reason()
            or self._lost_records()
            or self._discarded_states()
            or self._tls.degraded_reason(now_utc_s)
        )

    def _lost_records(self) -> str:
        if self._store.lost is None:
            return ""
        records, name = str(self._store.lost) or "none", self._store.path.name
        return f"commits of {name} are lost; records possibly lost: {records}; see `sonarpost store check`"

    def _discarded_count(self) -> int:
        return self._counters["states_discarded"] + self._store.states_discarded

    def _discarded_states(self) -> str:
        count = self._discarded_count()
        return f"stored states discarded since the start: {count}; they are in the quarantine" if count else ""

    def report(self, state: ServiceState | None = None) -> Health | None:
        """Report the health to the supervisor; return the record to publish, None if the store cannot be read."""
        try:
            record = self.record(state)
        except DeliveryError as error:
            self.manager.alive(f"health unknown: {error}")  # the process does not hang
            log.warning("Health not published", extra=kv(error=str(error)))
            return None
        self._heartbeat.beat(record, time.monotonic())
        self.manager.alive(f"{record.state}: {record.detail}" if record.detail else record.state)
        return record
