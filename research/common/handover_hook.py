"""Counters in every process of a chain: `research.handover_counts` puts this file as `sitecustomize.py` on its path.

Each process writes its counters to a file of its own in the folder HANDOVER_COUNTS, whose name begins with that of its
module. They are in shared memory of the file: a process that is killed has written them as well.
"""

import importlib.abc
import importlib.machinery
import mmap
import os
import sqlite3
import struct
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import msgpack
from typing_extensions import override

COUNTERS = ("encodes", "decodes", "unpacked", "commits", "fsyncs", "coding_ns")
"""Records packed; unpacked and validated; unpacked for a log line or some fields; commits of changed rows; `os.fsync`
and `os.fdatasync`; processor time of the codec."""
STATES = (
    "health",
    "queue_state",
    "downlink_state",
    "link_quality",
    "vehicle_status",
    "received_status",
    "vehicle_range",
)
COPIES = ("acoustic_frame", "transmission", "transmissions")
"""Records that are not counted: of the present state, and of frames for watchers."""
CODING = {"sonarpost.archive.decoder": "Decoder.decode", "sonarpost.services.compressor.encoding": "encode"}
"""Functions that code images, by their module."""
SIZE = struct.Struct(f"<{len(COUNTERS)}Q")


class Counters:
    """Counters of this process."""

    def __init__(self, folder: Path) -> None:
        module = sys.orig_argv[sys.orig_argv.index("-m") + 1] if "-m" in sys.orig_argv else "other"
        with (folder / f"{module.rpartition('.')[2]}.{os.getpid()}").open("w+b") as file:
            file.truncate(SIZE.size)
            self._memory = mmap.mmap(file.fileno(), SIZE.size)
        self._values = [0] * len(COUNTERS)
        self._lock = threading.RLock()

    def add(self, name: str, by: int = 1) -> None:
        """Increase a counter."""
        with self._lock:
            self._values[COUNTERS.index(name)] += by
            SIZE.pack_into(self._memory, 0, *self._values)

    def count_records(self) -> None:
        """Count the records that msgpack packs and unpacks: maps with `type` and `v`."""
        pack, unpack = msgpack.packb, msgpack.unpackb

        def packb(value: object, **options: object) -> bytes:
            if _is_counted(value):
                self.add("encodes")
            packed: bytes = pack(value, **options)
            return packed

        def unpackb(packed: bytes, **options: object) -> object:
            value: object = unpack(packed, **options)
            if _is_counted(value):
                caller = sys._getframe(2).f_code.co_name  # noqa: SLF001  of `wire.unpack_map`
                self.add("decodes" if caller == "decode" else "unpacked")
            return value

        msgpack.packb, msgpack.unpackb = packb, unpackb

    def count_commits(self) -> None:
        """Count the transactions of SQLite that change rows."""
        changes: dict[int, int] = {}

        def traced(connection: sqlite3.Connection) -> sqlite3.Connection:
            changes[id(connection)] = 0

            def on_statement(sql: str) -> None:
                # One statement alone is a transaction of its own; its changes are counted with the next one.
                verb = sql.lstrip()[:6].upper()
                alone = verb in ("INSERT", "UPDATE", "DELETE", "REPLAC") and not connection.in_transaction
                if alone or (verb == "COMMIT" and connection.total_changes != changes[id(connection)]):
                    self.add("commits")
                changes[id(connection)] = connection.total_changes if verb == "COMMIT" else changes[id(connection)]

            connection.set_trace_callback(on_statement)
            return connection

        for module in (sqlite3, sqlite3.dbapi2):
            _wrap(module, "connect", lambda call: traced(call()))

    def count_fsyncs(self) -> None:
        """Count the files and folders that Python code writes to the disk."""

        def counted(call: Callable[[], object]) -> object:
            self.add("fsyncs")
            return call()

        for name in ("fsync", "fdatasync"):
            _wrap(os, name, counted)

    def time_coding(self, module: ModuleType) -> None:
        """Measure the processor time of the function of `CODING` in a module."""
        owner_name, _, name = CODING[module.__name__].rpartition(".")

        def timed(call: Callable[[], object]) -> object:
            began_ns = time.thread_time_ns()
            try:
                return call()
            finally:
                self.add("coding_ns", time.thread_time_ns() - began_ns)

        _wrap(getattr(module, owner_name) if owner_name else module, name, timed)


def _wrap(owner: object, name: str, around: Callable[[Callable[[], Any]], object]) -> None:
    """Replace a function of a module or class by `around`, which receives the call without its arguments."""
    function = getattr(owner, name)
    setattr(owner, name, lambda *args, **options: around(lambda: function(*args, **options)))


class CodingFinder(importlib.abc.MetaPathFinder):
    """Calls `on_import` with each module of `CODING`, after its import."""

    def __init__(self, on_import: Callable[[ModuleType], None]) -> None:
        self._on_import = on_import

    @override
    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Return the specification of such a module, with a loader that also calls `on_import`."""
        if name not in CODING:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_call(module: ModuleType) -> None:
                execute(module)
                self._on_import(module)

            spec.loader.exec_module = execute_and_call  # type: ignore[method-assign]
        return spec


def _is_counted(value: object) -> bool:
    return isinstance(value, dict) and {"type", "v"} <= value.keys() and value["type"] not in (*STATES, *COPIES)


def install(folder: Path, *, timed: bool) -> None:
    """Count in this process; with `timed` only the time of the codec, as counting would take time itself."""
    counters = Counters(folder)
    if timed:
        sys.meta_path.insert(0, CodingFinder(counters.time_coding))
        return
    counters.count_records()
    counters.count_commits()
    counters.count_fsyncs()


if "HANDOVER_COUNTS" in os.environ:
    install(Path(os.environ["HANDOVER_COUNTS"]), timed="HANDOVER_TIMED" in os.environ)
