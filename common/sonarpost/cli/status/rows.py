"""From a fleet's state to the words of the table; pure, so that the live table, plain text and JSON agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from sonarpost.monitoring.fleet import FleetState, ServiceStatus

Mood = Literal["good", "bad", "doubtful", "gone"]

NOT_TOLD = "-"


@dataclass(frozen=True, slots=True)
class Row:
    """One service in words.

    Attributes:
        mood: How the row looks: all is well, something is wrong, what is shown is old, or the service is not there.
        detail: What the service says is wrong, empty when nothing.
    """

    platform: str
    service: str
    state: str
    heard: str
    inbox: str
    outbox: str
    link: str
    disk_free: str
    mood: Mood
    detail: str

    @property
    def cells(self) -> tuple[str, ...]:
        """The columns of the table, as in `HEADINGS`."""
        return (
            self.platform,
            self.service,
            self.state,
            self.heard,
            self.inbox,
            self.outbox,
            self.link,
            self.disk_free,
        )


HEADINGS = ("PLATFORM", "SERVICE", "STATE", "HEARD", "IN", "OUT", "LINK", "DISK")


def rows_of(state: FleetState, stale_after_s: float) -> tuple[Row, ...]:
    """Return a row for each service."""
    return tuple(_row(seen, stale_after_s) for seen in state.services)


def is_well(rows: tuple[Row, ...], state: FleetState) -> bool:
    """Return whether a router is reached, somebody is there, and everybody is well."""
    return state.connected and bool(rows) and all(row.mood == "good" for row in rows)


def _row(seen: ServiceStatus, stale_after_s: float) -> Row:
    health = seen.health
    words, mood = _state(seen, stale_after_s)
    gauges: Mapping[str, float] = health.gauges if health else {}
    return Row(
        platform=seen.platform,
        service=seen.service,
        state=words,
        heard=age_text(seen.age_s),
        inbox=_count(gauges.get("inbox")),
        outbox=_count(gauges.get("outbox")),
        link=_link(health.counters, gauges) if health else NOT_TOLD,
        disk_free=bytes_text(gauges.get("disk_free_bytes")),
        mood=mood,
        detail=health.detail if health else "",
    )


def _state(seen: ServiceStatus, stale_after_s: float) -> tuple[str, Mood]:
    health = seen.health
    if seen.alive is False:
        return ("stopped" if health is not None and health.state == "stopping" else "gone"), "gone"
    if health is None or seen.age_s is None:
        return "not heard", "doubtful"
    if seen.age_s > stale_after_s:
        return f"stale ({health.state})", "doubtful"
    if seen.alive is None:
        return f"{health.state}?", "doubtful"
    return health.state, "good" if health.state == "ok" else "bad"


def _link(counters: Mapping[str, int], gauges: Mapping[str, float]) -> str:
    """Return what a modem service says of the water, and what a relay says of the shore."""
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
    return ", ".join(parts) or NOT_TOLD


def _count(value: float | None) -> str:
    return NOT_TOLD if value is None else f"{value:.0f}"


def age_text(age_s: float | None) -> str:
    """Return 3 s, 4 min, 5 h or 6 d, rounded down; - when it is not known."""
    if age_s is None:
        return NOT_TOLD
    for unit, unit_s in (("d", 86400), ("h", 3600), ("min", 60)):
        if age_s >= unit_s:
            return f"{int(age_s // unit_s)} {unit}"
    return f"{int(age_s)} s"


def bytes_text(size_bytes: float | None) -> str:
    """Return 512 B, 3.4 kB, 12 MB, 120 GB, with two digits or more; - when it is not known."""
    if size_bytes is None:
        return NOT_TOLD
    value, unit = size_bytes, "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.1f} {unit}" if unit != "B" and value < 10 else f"{value:.0f} {unit}"
