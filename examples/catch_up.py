"""Prints every record of a shore site once, also those missed: catch_up.py tcp/127.0.0.1:7447 [CURSOR_FILE]."""

import json
import pathlib
import queue
import signal
import sys
import time
from typing import Any

import msgpack
import zenoh

KEY = "sonarpost/v1/shore/contact/*/*"


class Records:
    """Numbers of the records that were printed: all up to the cursor, and `ahead` of it those of publications."""

    def __init__(self, cursor: str) -> None:
        self.cursor = cursor
        self.ahead: set[int] = set()

    def reached(self) -> int:
        """Return the number in the cursor."""
        return int(self.cursor.partition(".")[2] or 0)

    def show(self, r: dict[str, Any]) -> int:
        """Print a record, unless it was printed before; return its number."""
        seq = int(r["accepted"]["seq"])
        if seq > self.reached() and seq not in self.ahead:
            names = ("type", "vehicle_id", "image_id", "version", "verdict")
            print(seq, *(r.get(name, "-") for name in names), flush=True)
        return seq

    def next_page(self, session: zenoh.Session) -> bool | None:
        """Query the records after the cursor and print them.

        Returns:
            Whether more remain; None if the page is incomplete.
        """
        # Without NONE, Zenoh keeps only the last reply of each key.
        none = zenoh.ConsolidationMode.NONE
        replies = list(session.get(f"{KEY}?after={self.cursor}", consolidation=none, timeout=30))
        for error in (reply.err for reply in replies if reply.err):
            if error.encoding == zenoh.Encoding.TEXT_PLAIN and ": busy: " not in error.payload.to_string():
                sys.exit(error.payload.to_string())
        values = [msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in replies if reply.ok]
        # By number: if several c2 of one archive reply, each sends the same records and a page.
        found = {r["accepted"]["seq"]: r for r in values if r["type"] != "page"}
        page = max((r for r in values if r["type"] == "page"), key=lambda page: page["records"], default=None)
        if page is None or page["records"] != len(found):
            return None  # c2 is away or busy, or a reply was lost
        for seq in sorted(found):
            self.show(found[seq])
        self.cursor = page["next"]
        self.ahead = {seq for seq in self.ahead if seq > self.reached()}
        return bool(page["more"])


signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program, also while it waits for the router
saved = pathlib.Path(sys.argv[2]) if len(sys.argv) > 2 else None
records = Records(saved.read_text() if saved and saved.exists() else "")
connect = {"endpoints": sys.argv[1:2], "timeout_ms": -1}  # wait for the router without a time limit
config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": connect}))
live: queue.Queue[zenoh.Sample] = queue.Queue()
with zenoh.open(config) as session, session.declare_subscriber(KEY, live.put):
    while True:
        # First everything missed, then publications for 30 s, then again what was lost on the way.
        while more := records.next_page(session):
            pass
        if saved:
            saved.write_text(records.cursor)
        until = time.monotonic() + (1 if more is None else 30)
        while (left := until - time.monotonic()) > 0:
            try:
                sample = live.get(timeout=left)
                records.ahead.add(records.show(msgpack.unpackb(sample.payload.to_bytes())))
            except queue.Empty:
                break
