"""`sonarpost status`: a live table of the services of all platforms."""

import argparse
import json
import logging
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import add_router_options, aligned, flag, option, printable, router_of
from sonarpost.errors import ConfigError
from sonarpost.monitoring.fleet import FleetState, FleetWatcher, ServiceStatus, VehicleState
from sonarpost.stop_signals import stop_on_signals

EXIT_NOT_OK = 1
UNKNOWN = "-"
HEADINGS = ("PLATFORM", "SERVICE", "STATE", "AGE", "IN", "OUT", "LINK", "DISK")

_RIGHT_ALIGNED = ("AGE", "IN", "OUT", "DISK")
_POLL_S = 0.05

Severity = Literal["ok", "error", "stale", "gone"]
_STYLES: dict[Severity, str] = {"ok": "", "error": "bold red", "stale": "yellow", "gone": "dim"}


def add_options(parser: CommandParser) -> None:
    """Add the subcommand."""
    parser.description = (
        "Show the services of all platforms at a router: state, queues, link, disk; and the position of "
        "each vehicle that reports its status. Ctrl-C ends it."
    )
    add_router_options(parser)
    flag(parser, "--once", "print once; exit status 0 if all services are ok, else 1")
    flag(parser, "--json", "print JSON lines instead of the table")
    option(parser, "--interval S", "time between updates", float, 1.0)
    option(
        parser,
        "--wait S",
        "with --once: time limit for health records (default: 6; services publish every 5 s)",
        float,
        6.0,
    )
    option(parser, "--stale-after S", "age at which health is stale", float, 15.0)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Show the state of the fleet; return 0, or with --once 1 if a service is not ok.

    Raises:
        ConfigError: A router option or a time is invalid.
    """
    for name in ("interval", "wait", "stale_after"):
        if not 0 < getattr(parsed, name) <= 86400:
            raise ConfigError("status", f"--{name.replace('_', '-')}", getattr(parsed, name), "above 0, to 86400")
    endpoints, tls = router_of(parsed)
    router = ", ".join(endpoints)
    console = Console(highlight=False)
    with (
        _logging_suppressed(),
        stop_on_signals() as stop,
        FleetWatcher(endpoints, tls, poll_s=min(1.0, parsed.interval)) as watcher,
    ):
        if parsed.once:
            state = _wait_for_health(watcher, stop, parsed.wait)
            _print_state(console, state, router, parsed)
            return 0 if is_ok(rows_of(state, parsed.stale_after), state) else EXIT_NOT_OK
        if parsed.json or not console.is_terminal:
            while not stop.wait(parsed.interval):
                _print_state(console, watcher.state(), router, parsed)
            return 0
        with Live(console=console, auto_refresh=False, screen=True) as live:
            while True:
                state = watcher.state()
                live.update(table(state, rows_of(state, parsed.stale_after), router), refresh=True)
                if stop.wait(parsed.interval):
                    return 0


def _print_state(console: Console, state: FleetState, router: str, parsed: argparse.Namespace) -> None:
    rows = rows_of(state, parsed.stale_after)
    if console.is_terminal and not parsed.json:
        console.print(table(state, rows, router))
        return
    now = datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    text = as_json(state, rows, now) if parsed.json else plain_text(state, rows, router)
    # Written directly: the console's `print` would wrap and colour the text.
    console.file.write(f"{text}\n")
    console.file.flush()


def _wait_for_health(watcher: FleetWatcher, stop: threading.Event, wait_s: float) -> FleetState:
    """Return the state when all running services have published health, or after `wait_s`."""
    deadline_s = time.monotonic() + wait_s
    while True:
        state = watcher.state()
        complete = state.connected and state.services and all(s.health or not s.alive for s in state.services)
        if complete or time.monotonic() > deadline_s or stop.wait(_POLL_S):
            return state


@contextmanager
def _logging_suppressed() -> Iterator[None]:
    """Suppress log lines, which would break the table."""
    logger = logging.getLogger("sonarpost")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


# Rows


@dataclass(frozen=True, slots=True)
class StatusRow:
    """One service as text.

    Attributes:
        cells: Text of the columns `HEADINGS`.
        severity: Colour of the row: ok, error, stale data, or the service is not running.
        detail: Problem reported by the service; empty if there is none.
    """

    cells: tuple[str, ...]
    severity: Severity
    detail: str

    @property
    def state(self) -> str:
        """Text of the column STATE."""
        return self.cells[2]


def rows_of(state: FleetState, stale_after_s: float) -> tuple[StatusRow, ...]:
    """Return a row for each service."""
    return tuple(_row(status, stale_after_s) for status in state.services)


def is_ok(rows: Sequence[StatusRow], state: FleetState) -> bool:
    """Return whether the router is reached and at least one service runs, all without a problem."""
    return state.connected and bool(rows) and all(row.severity == "ok" for row in rows)


def _row(status: ServiceStatus, stale_after_s: float) -> StatusRow:
    health = status.health
    state, severity = _state_text(status, stale_after_s)
    gauges: Mapping[str, float] = health.gauges if health else {}
    cells = (
        status.platform,
        status.service,
        state,
        age_text(status.age_s),
        _count_text(gauges.get("inbox")),
        _count_text(gauges.get("outbox")),
        _link_text(health.counters, gauges) if health else UNKNOWN,
        bytes_text(gauges.get("disk_free_bytes")),
    )
    return StatusRow(cells, severity, health.detail if health else "")


def _state_text(status: ServiceStatus, stale_after_s: float) -> tuple[str, Severity]:
    health = status.health
    if status.alive is False:
        return ("stopped" if health is not None and health.state == "stopping" else "gone"), "gone"
    if health is None or status.age_s is None:
        return "no data", "stale"
    if status.age_s > stale_after_s:
        return f"stale ({health.state})", "stale"
    if status.alive is None:
        return f"{health.state}?", "stale"
    return health.state, "ok" if health.state == "ok" else "error"


def _link_text(counters: Mapping[str, int], gauges: Mapping[str, float]) -> str:
    """Return the state of the acoustic link for a modem service, and the queues to the shore sites for a relay."""
    parts: list[str] = []
    if gauges.get("modem_ready") == 0.0:
        parts.append("no modem")
    if (snr_db := gauges.get("snr_in_db")) is not None:
        parts.append(f"SNR {snr_db:.0f} dB")
    good, bad = counters.get("frames_received", 0), counters.get("frames_bad", 0)
    if good + bad:
        parts.append(f"loss {100 * bad / (good + bad):.0f} %")
    sent, failed = counters.get("packets_sent", 0), counters.get("packets_failed", 0)
    if sent + failed:
        parts.append(f"sent {sent}" + (f", failed {failed}" if failed else ""))
    for name, waiting in gauges.items():
        if name.startswith("waiting_for_") and waiting:
            parts.append(f"{waiting:.0f} for {name.removeprefix('waiting_for_')}")
    return ", ".join(parts) or UNKNOWN


def _count_text(value: float | None) -> str:
    return UNKNOWN if value is None else f"{value:.0f}"


def age_text(age_s: float | None) -> str:
    """Return 3 s, 4 min, 5 h or 6 d, rounded down; `-` for None."""
    if age_s is None:
        return UNKNOWN
    for unit, unit_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if age_s >= unit_s:
            return f"{int(age_s // unit_s)} {unit}"
    return f"{int(age_s)} s"


def bytes_text(size_bytes: float | None) -> str:
    """Return 512 B, 3.4 kB, 12 MB, 120 GB, with at least two digits; `-` for None."""
    if size_bytes is None:
        return UNKNOWN
    value, unit = size_bytes, "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.1f} {unit}" if unit != "B" and value < 10 else f"{value:.0f} {unit}"


# Output


def table(state: FleetState, rows: Sequence[StatusRow], router: str) -> RenderableType:
    """Return the table for a terminal. It fits 80 columns; longer names are folded."""
    whole = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, collapse_padding=True, show_edge=False)
    for heading in HEADINGS:
        whole.add_column(heading, justify="right" if heading in _RIGHT_ALIGNED else "left", overflow="fold")
    previous = ""
    for row in rows:
        # The platform is shown once, in its first row.
        platform, *others = row.cells
        cells = ["" if platform == previous else platform, *others]
        previous = platform
        whole.add_row(*(Text(printable(cell)) for cell in cells), style=_STYLES[row.severity])
    headline = Text(_headline(state, router), style="" if state.connected else "bold red")
    vehicles = (Text(line, overflow="fold") for line in _vehicle_lines(state))
    return Group(headline, whole, *vehicles, *(Text(line, style="red", overflow="fold") for line in _details(rows)))


def plain_text(state: FleetState, rows: Sequence[StatusRow], router: str) -> str:
    """Return the table as plain text, with columns aligned by spaces."""
    lines = aligned([HEADINGS, *([printable(cell) for cell in row.cells] for row in rows)])
    return "\n".join([_headline(state, router), *lines, *_vehicle_lines(state), *_details(rows)])


def as_json(state: FleetState, rows: Sequence[StatusRow], time_utc: str) -> str:
    """Return the health records and the states of the table as one line of JSON."""
    services = []
    for status, row in zip(state.services, rows, strict=True):
        health = status.health
        services.append(
            {
                "platform": status.platform,
                "service": status.service,
                "alive": status.alive,
                "status": row.state,
                "well": row.severity == "ok",
                "age_s": None if status.age_s is None else round(status.age_s, 1),
                "state": health.state if health else None,
                "detail": health.detail if health else None,
                "started_utc_s": health.started_utc_s if health else None,
                "time_utc_s": health.time_utc_s if health else None,
                "counters": health.counters if health else {},
                "gauges": health.gauges if health else {},
            }
        )
    vehicles = [{**one.received.model_dump(), "age_s": round(one.age_s, 1)} for one in state.vehicles]
    whole = {
        "time_utc": time_utc,
        "connected": state.connected,
        "failure": state.failure,
        "rejected": state.rejected,
        "services": services,
        "vehicles": vehicles,
        "ranges": [{**record.model_dump(), "age_s": round(age_s, 1)} for record, age_s in state.ranges],
    }
    return json.dumps(whole)


def _headline(state: FleetState, router: str) -> str:
    if not state.connected:
        reason = f" ({printable(state.failure)})" if state.failure else ""
        return f"{router}: router not reached{', the data below is old' if state.services else ' yet'}{reason}"
    alive = sum(status.alive is True for status in state.services)
    platforms = len({status.platform for status in state.services})
    rejected = f", {state.rejected} records rejected" if state.rejected else ""
    return f"{router}: {alive} of {len(state.services)} services alive on {platforms} platforms{rejected}"


def _vehicle_lines(state: FleetState) -> list[str]:
    """Return a line for each vehicle with a status, and one for each measured distance, with their ages."""
    ranges = [
        f"{one.vehicle_id}: {one.distance_m:.0f} m from {one.vessel_id}, measured {age_text(age_s)} ago"
        for one, age_s in state.ranges
    ]
    return [printable(text) for text in (*(vehicle_text(one) for one in state.vehicles), *ranges)]


def vehicle_text(vehicle: VehicleState) -> str:
    """Return the last status of a vehicle on one line, values that are not known left out."""
    received, status = vehicle.received, vehicle.received.status
    at = datetime.fromtimestamp(status.time_utc_s, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    position = "no position"
    if status.lat_deg is not None and status.lon_deg is not None:
        position = f"{status.lat_deg:.5f}, {status.lon_deg:.5f} at {at}"
    values = (
        ("heading", status.heading_deg, "°", 0),
        ("speed", status.speed_mps, " m/s", 1),
        ("depth", status.depth_m, " m", 1),
        ("altitude", status.altitude_m, " m", 1),
        ("battery", None if status.battery is None else 100 * status.battery, " %", 0),
        ("images waiting", status.images_waiting, "", 0),
    )
    known = [f"{name} {value:.{decimals}f}{unit}" for name, value, unit, decimals in values if value is not None]
    if status.disk_free_bytes is not None:
        known.append(f"disk {bytes_text(status.disk_free_bytes)}")
    heard = f"received {age_text(vehicle.age_s)} ago by {received.vessel_id}"
    return f"{received.vehicle_id}: " + ", ".join([position, *known, heard])


def _details(rows: Sequence[StatusRow]) -> list[str]:
    return [f"! {row.cells[0]}/{row.cells[1]}: {printable(row.detail)}" for row in rows if row.detail]
