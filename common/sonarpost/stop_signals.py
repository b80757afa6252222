"""End of a process: SIGINT, SIGTERM, the end of its parent, and the exit itself."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

EXIT_WITH_PARENT = "SONARPOST_EXIT_WITH_PARENT"
EXIT_ORPHANED = 1
_PR_SET_PDEATHSIG = 1
_WAKE_S = 0.5


@contextmanager
def stop_on_signals() -> Iterator[threading.Event]:
    """Return an event that SIGINT and SIGTERM set, so that a command can clean up before it ends.

    Outside the main thread, which alone can handle signals, no signal sets it.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def wait_until_set(stop: threading.Event) -> None:
    """Wait in the main thread for an event that a signal handler sets.

    Python runs the handler when the main thread wakes. The system can deliver the signal to another thread, which does
    not wake the main thread, so the wait has a limit and is repeated.
    """
    while not stop.wait(_WAKE_S):
        pass


def exit_with_parent() -> None:
    """End this process when its parent ends, if `SONARPOST_EXIT_WITH_PARENT` holds the parent's process id (Linux)."""
    parent = os.environ.get(EXIT_WITH_PARENT)
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        # The parent ended before prctl took effect.
        os._exit(EXIT_ORPHANED)


def exit_process(status: int) -> NoReturn:
    """End this process after its output is written; threads of libraries are not waited for.

    At the usual end of the interpreter, a thread of Zenoh that waits for the interpreter's lock aborts the process.
    """
    logging.shutdown()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except BrokenPipeError:
        pass  # the reader has closed the output
    os._exit(status)
