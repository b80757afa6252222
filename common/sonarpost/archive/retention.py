"""Retention: which stored items are removed because of their age or of the total size, and files in folders."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Generic, TypeVar

DAY_S = 86400.0
UNLISTED = "modem-"
"""Start of the name of a vehicle that is not in the configuration."""
EARLIEST_UTC_S = 1_577_836_800.0
"""2020-01-01: an earlier time of storage shows that the clock was not set; the age of the item is unknown."""
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Stored(Generic[T]):
    """An item that retention can remove.

    Attributes:
        item: The item.
        stored_utc_s: When it was stored.
        size_bytes: Its size.
        order: Items of a lower order are removed first because of the total size, among those of the same source.
        source: Vessel or vehicle that it came from.
    """

    item: T
    stored_utc_s: float
    size_bytes: int
    order: int = 0
    source: str = ""


def vehicle_source(vehicle_id: str) -> str:
    """Return `Stored.source` of a vehicle: one for all without a configured name, whose addresses can be forged."""
    return UNLISTED if vehicle_id.startswith(UNLISTED) else vehicle_id


def select_for_removal(
    stored: Iterable[Stored[T]], now_utc_s: float, retain_days: float | None, max_bytes: int | None
) -> list[T]:
    """Select the items that retention removes.

    Items stored longer than `retain_days` before the newest one are removed, except those of unknown age: a clock that
    is ahead makes no item old. Of the others, those of the source with the most bytes are removed, those of the lowest
    order first, oldest first, until at most `max_bytes` remain. None stands for no limit.
    """
    ordered = sorted(stored, key=lambda e: (e.order, e.stored_utc_s))  # stable: items of one time stay in order
    now_utc_s = min(now_utc_s, max((each.stored_utc_s for each in ordered), default=0.0))
    old: list[T] = []
    sizes: Counter[str] = Counter()
    kept: dict[str, list[Stored[T]]] = {}
    for each in reversed(ordered):
        age_s = now_utc_s - each.stored_utc_s if each.stored_utc_s >= EARLIEST_UTC_S else 0.0
        if retain_days is not None and age_s > retain_days * DAY_S:
            old.append(each.item)
        else:
            sizes[each.source] += each.size_bytes
            kept.setdefault(each.source, []).append(each)
    old.reverse()
    total = sizes.total()
    while max_bytes is not None and total > max_bytes:
        largest = max(sizes, key=lambda source: (sizes[source], source))
        removed = kept[largest].pop()
        sizes[largest] -= removed.size_bytes
        total -= removed.size_bytes
        old.append(removed.item)
    return old


def stored_files(folder: Path, suffixes: tuple[str, ...]) -> list[Stored[str]]:
    """Return the files of a folder by their names without suffix: files of one name are one item.

    An item is as old as its newest file. Names that begin with a dot are skipped (a file being written). A folder that
    does not exist has no items.

    Raises:
        OSError: The folder cannot be read.
    """
    found: dict[str, Stored[str]] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() not in suffixes or path.name.startswith(".") or not path.is_file():
            continue
        status = path.stat()
        before = found.get(path.stem, Stored(path.stem, 0.0, 0))
        found[path.stem] = replace(
            before,
            stored_utc_s=max(before.stored_utc_s, status.st_mtime),
            size_bytes=before.size_bytes + status.st_size,
        )
    return list(found.values())


def remove_files(
    folder: Path,
    suffixes: tuple[str, ...],
    now_utc_s: float,
    retain_days: float | None,
    max_bytes: int | None,
    order: Callable[[str, frozenset[str]], int] = lambda _name, _names: 0,
    source: Callable[[str], str] = lambda _name: "",
) -> list[str]:
    """Remove files of a folder by age and total size; return their names without suffix.

    Args:
        folder: The folder; its subfolders are not searched.
        suffixes: Suffixes of the files, lower case, in the order of their removal.
        now_utc_s: Current time.
        retain_days: See `select_for_removal`.
        max_bytes: See `select_for_removal`.
        order: Returns `Stored.order` of a name among all names.
        source: Returns `Stored.source` of a name.

    Raises:
        OSError: The folder cannot be read, or a file cannot be deleted.
    """
    stored = stored_files(folder, suffixes)
    names = frozenset(each.item for each in stored)
    described = [replace(each, order=order(each.item, names), source=source(each.item)) for each in stored]
    selected = select_for_removal(described, now_utc_s, retain_days, max_bytes)
    for name in selected:
        for suffix in suffixes:
            (folder / f"{name}{suffix}").unlink(missing_ok=True)
    return selected
