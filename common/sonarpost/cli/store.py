"""`sonarpost store check`, `salvage` and `quarantine`: the store of a stopped service."""

import argparse
import time
from contextlib import closing
from pathlib import Path

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import flag, in_new_folder, option, print_table, time_text
from sonarpost.delivery.schema import VERSION
from sonarpost.delivery.stopped_store import StoreState, TableResult, inspect, salvage
from sonarpost.delivery.store import Store, lock_exclusively
from sonarpost.errors import StoredFileError

EXIT_UNSOUND = 1

_CHECK = """Check the store of a stopped service: integrity, schema version, queues, and lost commits by the side-car
STORE.watermark. Nothing is changed without --clear. Exit status: 0 if the store is sound, 1 if it is damaged, has
another version or has lost commits, 2 if it cannot be checked, for example because the service is running."""
_SALVAGE = """Copy every readable row of a damaged store into a new file, and print what was recovered. Exit status: 0
if every row was copied, 1 if rows are missing, 2 if nothing was written, for example because the service is running."""

_QUARANTINE = """List the quarantined records of a stopped service, oldest first: number, time, direction, key, bytes,
reason. --requeue moves received records to the inbox; the service handles them after its next start. Exit status: 0, or
1 if one of the named records cannot be queued, because it is cut, was refused by a consumer, or is no record."""


def add_actions(parser: CommandParser) -> None:
    """Add the command and its actions."""
    check = parser.add_action("check", "check a store, and report lost commits", run_check, "state/relay.db", _CHECK)
    option(check, "store STORE", "store of a service, for example relay.db", Path)
    flag(check, "--clear", "clear the report of lost commits; the service is no longer degraded")
    copy = parser.add_action(
        "salvage",
        "copy the readable rows of a damaged store",
        run_salvage,
        "state/relay.db --out relay-new.db",
        _SALVAGE,
    )
    option(copy, "store STORE", "the damaged store", Path)
    option(copy, "--out NEW", "new store; the file must not exist", Path, required=True)
    kept = parser.add_action(
        "quarantine",
        "list quarantined records, queue them again",
        run_quarantine,
        "state/c2.db --requeue",
        _QUARANTINE,
    )
    option(kept, "store STORE", "store of a service, for example c2.db", Path)
    option(kept, "--requeue ID", "queue these received records again; all without an ID", int, nargs="*")


def run_check(parsed: argparse.Namespace) -> int:
    """Print the state of a store; return 0 if it is sound, otherwise 1."""
    path: Path = parsed.store
    if not path.is_file():
        raise StoredFileError(str(path), "", "no such file", "the store of a service, for example relay.db")
    if parsed.clear:
        with closing(Store(path)) as store:
            lost = store.clear_lost()
        print("no report of lost commits" if lost is None else f"cleared: records possibly lost: {lost}")
    with lock_exclusively(path):
        state = inspect(path)
    _print_state(path, state)
    return 0 if state.is_sound else EXIT_UNSOUND


def _print_state(path: Path, state: StoreState) -> None:
    version = state.version or "unknown"
    expected = "" if version == str(VERSION) else f", expected {VERSION}"
    lines = [
        ("store", str(path)),
        ("integrity", "ok" if not state.problems else f"{len(state.problems)} problems"),
        *(("", problem) for problem in state.problems),
        ("schema version", version + expected),
        ("side-car", state.side_car),
    ]
    if state.unreported is not None:
        lines.append(("lost commits", f"records possibly lost: {state.unreported}; not yet reported by the service"))
    if state.lost is not None:
        found = time_text(state.lost.found_utc_s)
        lines.append(
            ("lost commits", f"records possibly lost: {state.lost}; found {found} UTC; --clear ends the report")
        )
    print_table(lines)
    print()
    rows = [("queue", "records", "bytes", "oldest (UTC)", "age", "last number")]
    now_utc_s = time.time()
    for queue in state.queues:
        age = "" if queue.oldest_utc_s is None else f"{max(0.0, now_utc_s - queue.oldest_utc_s):.0f} s"
        counts = (str(queue.records), str(queue.size_bytes))
        rows.append((queue.name, *counts, time_text(queue.oldest_utc_s), age, str(queue.last)))
    print_table(rows)
    if state.problems:
        print(f"\nRecover the readable records: sonarpost store salvage {path} --out NEW")


def run_quarantine(parsed: argparse.Namespace) -> int:
    """List quarantined records, or queue them again; return 1 if one of them cannot be queued, otherwise 0."""
    path: Path = parsed.store
    if not path.is_file():
        raise StoredFileError(str(path), "", "no such file", "the store of a service, for example c2.db")
    with closing(Store(path)) as store:
        found = store.quarantined()
        if parsed.requeue is None:
            rows = [("number", "time (UTC)", "direction", "key", "bytes", "reason")]
            rows += [(str(r.id), time_text(r.at_utc_s), r.direction, r.key, str(r.size_bytes), r.reason) for r in found]
            print_table(rows)
            return 0
        wanted = set(parsed.requeue or (record.id for record in found if record.can_be_queued))
        queued = [record.id for record in found if record.id in wanted and record.can_be_queued]
        with store.transaction() as tx:
            for number in queued:
                tx.requeue(number)
    print(f"{len(queued)} records queued again")
    left = sorted(wanted.difference(queued))
    if left:
        print(f"not queued: {', '.join(map(str, left))}")
    return EXIT_UNSOUND if left else 0


def run_salvage(parsed: argparse.Namespace) -> int:
    """Copy a store and print the result; return 0 if every row was copied, otherwise 1."""
    path, out = parsed.store, in_new_folder(parsed.out)
    results = salvage(path, out)
    rows = [("table", "recovered", "unreadable")]
    print_table([*rows, *((table.name, str(table.recovered), _unreadable(table)) for table in results)])
    print(f"""
Replace the damaged store while the service is stopped; leave {path}.watermark where it is:
  mv {path} {path}.damaged
  [ ! -e {path}-wal ] || mv {path}-wal {path}.damaged-wal
  rm -f {path}-shm
  mv {out} {path}""")
    return 0 if all(table.is_complete for table in results) else EXIT_UNSOUND


def _unreadable(table: TableResult) -> str:
    if table.error:
        return f"rows of unknown number: {table.error}"
    ranges = [f"{first} to {'the end' if last is None else last}" for first, last in table.unreadable]
    return "row " + ", ".join(ranges) if ranges else "-"
