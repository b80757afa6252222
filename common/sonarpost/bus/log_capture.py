"""Takes over what Zenoh's core writes to the standard output of this process, and reads it line by line."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import TextIO

import zenoh

from sonarpost.bus import zenoh_log
from sonarpost.bus.zenoh_log import Event, ZenohLog


class LogCapture:
    """Takes over Zenoh's log of this process: everything that is written to standard output.

    Lines that are not Zenoh's go where they would have gone.
    """

    def __init__(self) -> None:
        self._listener: Callable[[Event], None] | None = None
        self._waiting: list[Event] = []
        self._lock = threading.Lock()
        reader, writer = os.pipe()
        self._out: TextIO = os.fdopen(os.dup(1), "w", encoding="utf-8", errors="backslashreplace")
        os.dup2(writer, 1)
        os.close(writer)
        # The environment may ask for more, which then goes its usual way; what we read must be among it.
        self._asked = os.environ.get("RUST_LOG", "")
        os.environ["RUST_LOG"] = f"{self._asked},{zenoh_log.FILTER}" if self._asked else zenoh_log.FILTER
        self._thread = threading.Thread(target=self._read, args=(reader,), name="zenoh-log", daemon=True)
        self._thread.start()
        zenoh.init_log_from_env_or(zenoh_log.FILTER)

    def listen(self, listener: Callable[[Event], None]) -> None:
        """Hand every event, those of before among them, to `listener`."""
        with self._lock:
            self._listener = listener
            waiting, self._waiting = self._waiting, []
            for event in waiting:
                listener(event)

    def _read(self, reader: int) -> None:
        parser = ZenohLog()
        with os.fdopen(reader, encoding="utf-8", errors="backslashreplace", newline="\n") as lines:
            for line in lines:
                try:
                    event = parser.feed(line)
                except ValueError:
                    self._write(line)
                    continue
                if event is not None:
                    self._pass_on(event)
                elif self._asked:
                    self._write(line)

    def _write(self, line: str) -> None:
        self._out.write(line)
        self._out.flush()

    def _pass_on(self, event: Event) -> None:
        with self._lock:
            if self._listener is not None:
                self._listener(event)
            else:
                self._waiting.append(event)
