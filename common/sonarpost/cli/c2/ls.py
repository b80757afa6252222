"""`sonarpost c2 ls`: a table of what a site has accepted, from c2's index."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from sonarpost.archive.shore_index import DecisionRow, ImageRow, ShoreIndex, TaskingRow
from sonarpost.cli.c2.options import add_out_dir, printable, since_of, time_text

PIPED_WIDTH = 160


@dataclass(frozen=True, slots=True)
class Listed:
    """A picture and the latest decision about it."""

    picture: ImageRow
    decision: DecisionRow | None


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("ls", help="list accepted pictures with their decisions, or advice and commands")
    add_out_dir(parser)
    parser.add_argument("--vessel", metavar="NAME", help="of this vessel only")
    parser.add_argument("--vehicle", metavar="NAME", help="of this vehicle only")
    parser.add_argument("--since", metavar="TIME", help="first seen since then: 90m, 2h, 3d ago, or a time (UTC)")
    parser.add_argument("--undecided", action="store_true", help="only what no operator has decided about")
    parser.add_argument("--all-versions", action="store_true", help="every version of a picture, not only the newest")
    parser.add_argument("--tasking", action="store_true", help="advice and commands, and how far they have come")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Print the table; return 0.

    Raises:
        KeptFileError: There is no index where c2 is said to keep it.
        ConfigError: `--since` is no time.
    """
    since_utc_s = since_of(parsed.since)
    index = ShoreIndex(parsed.out_dir, writable=False)
    try:
        if parsed.tasking:
            return _print_tasking(_chosen(index.tasking(), parsed, since_utc_s), as_json=parsed.json)
        pictures = index.pictures()
        listed = join(pictures, index.decisions())
    finally:
        index.close()
    rows = select(
        listed,
        vessel=parsed.vessel,
        vehicle=parsed.vehicle,
        since_utc_s=since_utc_s,
        undecided=parsed.undecided,
        all_versions=parsed.all_versions,
    )
    if parsed.json:
        for row in rows:
            decision = None if row.decision is None else asdict(row.decision)
            print(json.dumps({**asdict(row.picture), "decision": decision}))
        return 0
    _print_pictures(rows)
    return 0


def join(pictures: Sequence[ImageRow], decisions: Iterable[DecisionRow]) -> list[Listed]:
    """Give every picture the latest decision about it.

    Where a vehicle began its identifiers anew, a decision is about the last picture of that name that had begun to
    arrive when it was made; where there is one picture only, about that, whatever the clocks say.
    """
    starts: dict[tuple[str, str, str], list[float]] = {}
    for row in pictures:
        known = starts.setdefault((row.vessel_id, row.vehicle_id, row.image_id), [])
        if row.first_frame_utc_s not in known:
            known.append(row.first_frame_utc_s)
    latest: dict[tuple[str, str, str, float], DecisionRow] = {}
    for decision in sorted(decisions, key=lambda d: (d.decided_utc_s, d.decision_id)):
        name = (decision.vessel_id, decision.vehicle_id, decision.image_id)
        known = starts.get(name, [])
        begun = [start for start in known if start <= decision.decided_utc_s]
        if begun or len(known) == 1:
            latest[(*name, max(begun, default=known[0]))] = decision
    return [
        Listed(row, latest.get((row.vessel_id, row.vehicle_id, row.image_id, row.first_frame_utc_s)))
        for row in pictures
    ]


def select(
    listed: Iterable[Listed],
    *,
    vessel: str | None = None,
    vehicle: str | None = None,
    since_utc_s: float = 0.0,
    undecided: bool = False,
    all_versions: bool = False,
) -> list[Listed]:
    """Return what the options leave, in the order given."""
    rows = [
        row
        for row in listed
        if vessel in (None, row.picture.vessel_id)
        and vehicle in (None, row.picture.vehicle_id)
        and row.picture.first_frame_utc_s >= since_utc_s
        and not (undecided and row.decision is not None)
    ]
    if all_versions:
        return rows
    newest: dict[tuple[str, str, str, float], Listed] = {}
    for row in rows:
        picture = row.picture
        name = (picture.vessel_id, picture.vehicle_id, picture.image_id, picture.first_frame_utc_s)
        if name not in newest or newest[name].picture.version < picture.version:
            newest[name] = row
    return list(newest.values())


def _chosen(rows: Iterable[TaskingRow], parsed: argparse.Namespace, since_utc_s: float) -> list[TaskingRow]:
    return [
        row
        for row in rows
        if parsed.vessel in (None, row.vessel_id)
        and parsed.vehicle in (None, row.vehicle_id)
        and row.issued_utc_s >= since_utc_s
    ]


def _print_pictures(rows: Sequence[Listed]) -> None:
    table = _table("vessel", "picture", "v", "first seen (UTC)", "missing", "position", "detector", "decision", "by")
    for row in rows:
        picture, decision = row.picture, row.decision
        known = picture.lat_deg is not None and picture.lon_deg is not None
        sure = "" if picture.atd_confidence is None else f"{picture.atd_confidence:.2f}"
        _add(
            table,
            picture.vessel_id,
            f"{picture.vehicle_id}/{picture.image_id}",
            str(picture.version),
            time_text(picture.first_frame_utc_s),
            f"{100 * picture.missing_fraction:.0f} %",
            f"{picture.lat_deg:.5f} {picture.lon_deg:.5f}" if known else "",
            " ".join(part for part in (picture.atd_class or "", sure) if part),
            "" if decision is None else " ".join(p for p in (decision.verdict, decision.mlo_class or "") if p),
            "" if decision is None else decision.operator,
        )
    _print(table, len(rows), "pictures")


def _print_tasking(rows: Sequence[TaskingRow], *, as_json: bool) -> int:
    if as_json:
        for row in rows:
            print(json.dumps(asdict(row)))
        return 0
    table = _table("vessel", "kind", "id", "picture", "says", "by", "issued (UTC)", "state", "reason")
    for row in rows:
        picture = row.vehicle_id if row.image_id is None else f"{row.vehicle_id}/{row.image_id}"
        said = (row.summary, row.author, time_text(row.issued_utc_s), row.state, row.reason)
        _add(table, row.vessel_id, row.kind, row.record_id, picture, *said)
    _print(table, len(rows), "records")
    return 0


def _table(*columns: str) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _add(table: Table, *cells: str) -> None:
    table.add_row(*(Text(printable(cell)) for cell in cells))


def _print(table: Table, count: int, what: str) -> None:
    console = Console(highlight=False)
    if not console.is_terminal:
        # A file or a pipe has no width: one row a line, for grep.
        console = Console(highlight=False, width=PIPED_WIDTH)
    console.print(table)
    console.print(f"{count} {what}")
