"""The rows as a table for a terminal, as plain text, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from sonarpost.cli.status.rows import HEADINGS, Mood, Row
from sonarpost.monitoring.fleet import FleetState

_STYLES: dict[Mood, str] = {"good": "", "bad": "bold red", "doubtful": "yellow", "gone": "dim"}
_RIGHT = ("HEARD", "IN", "OUT", "DISK")


def table(state: FleetState, rows: Sequence[Row], router: str) -> RenderableType:
    """Return the live table; it fits 80 columns, longer names are folded."""
    whole = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, collapse_padding=True, show_edge=False)
    for heading in HEADINGS:
        whole.add_column(heading, justify="right" if heading in _RIGHT else "left", overflow="fold")
    before = ""
    for row in rows:
        # A platform is named once, above its services.
        first, *others = row.cells
        cells = ["" if first == before else first, *others]
        before = first
        whole.add_row(*(Text(printable(cell)) for cell in cells), style=_STYLES[row.mood])
    parts: list[RenderableType] = [Text(headline(state, router), style="" if state.connected else "bold red"), whole]
    parts += [Text(line, style="red", overflow="fold") for line in details(rows)]
    return Group(*parts)


def plain(state: FleetState, rows: Sequence[Row], router: str) -> str:
    """Return the same as text, every row whole, columns aligned by spaces."""
    lines = [HEADINGS, *(tuple(printable(cell) for cell in row.cells) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADINGS))]
    out = [headline(state, router)]
    out += ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    return "\n".join([*out, *details(rows)])


def as_json(state: FleetState, rows: Sequence[Row], time_utc: str) -> str:
    """Return one line: everything the health records say, and what the table makes of it."""
    services = []
    for seen, row in zip(state.services, rows, strict=True):
        health = seen.health
        services.append(
            {
                "platform": seen.platform,
                "service": seen.service,
                "alive": seen.alive,
                "status": row.state,
                "well": row.mood == "good",
                "age_s": None if seen.age_s is None else round(seen.age_s, 1),
                "state": health.state if health else None,
                "detail": health.detail if health else None,
                "started_utc_s": health.started_utc_s if health else None,
                "time_utc_s": health.time_utc_s if health else None,
                "counters": health.counters if health else {},
                "gauges": health.gauges if health else {},
            }
        )
    whole = {"time_utc": time_utc, "connected": state.connected, "rejected": state.rejected, "services": services}
    return json.dumps(whole)


def headline(state: FleetState, router: str) -> str:
    """Return the line above the table."""
    if not state.connected:
        return f"{router}: router not reached, what is below is old" if state.services else f"{router}: not reached yet"
    there = sum(seen.alive is True for seen in state.services)
    platforms = len({seen.platform for seen in state.services})
    rejected = f", {state.rejected} records rejected" if state.rejected else ""
    return f"{router}: {there} of {len(state.services)} services alive on {platforms} platforms{rejected}"


def details(rows: Sequence[Row]) -> list[str]:
    """Return a line for each service that says what is wrong."""
    return [f"! {row.platform}/{row.service}: {printable(row.detail)}" for row in rows if row.detail]


def printable(text: str) -> str:
    """Return text without what would move a terminal's cursor: names and details come from outside."""
    return text if text.isprintable() else "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
