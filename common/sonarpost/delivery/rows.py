"""Many rows with one statement: every statement lets go of the interpreter's lock, and waits to get it back."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from functools import cache

ROWS_AT_ONCE = 32


@cache
def _insert(table: str, columns: str, marks: int, rows: int) -> str:
    values = ", ".join(["(" + ", ".join("?" * marks) + ")"] * rows)
    return f"INSERT INTO {table} ({columns}) VALUES {values}"  # noqa: S608 names of ours


def insert(db: sqlite3.Connection, table: str, columns: str, rows: Sequence[tuple[object, ...]]) -> None:
    """Insert rows of equal length.

    Args:
        db: Connection.
        table: Its name.
        columns: Their names, with commas between.
        rows: A value for each column.
    """
    for first in range(0, len(rows), ROWS_AT_ONCE):
        some = rows[first : first + ROWS_AT_ONCE]
        if len(some) < ROWS_AT_ONCE:
            db.executemany(_insert(table, columns, len(some[0]), 1), some)
        else:
            db.execute(_insert(table, columns, len(some[0]), len(some)), [value for row in some for value in row])


def runs(numbers: Iterable[int]) -> Iterator[tuple[int, int]]:
    """Give the unbroken runs among numbers as (first, last), in ascending order."""
    first: int | None = None
    last = 0
    for number in sorted(numbers):
        if first is not None and number == last + 1:
            last = number
            continue
        if first is not None:
            yield first, last
        first = last = number
    if first is not None:
        yield first, last
