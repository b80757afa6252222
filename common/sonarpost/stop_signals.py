"""End of a process: SIGINT, SIGTERM, the end of its parent, and the exit itself."""

import ctypes
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, NoReturn

from sonarpost.limits import limit

EXIT_WITH_PARENT = "SONARPOST_EXIT_WITH_PARENT"
EXIT_ORPHANED = 1
_PR_SET_PDEATHSIG = 1
_NUMBERS: Final = (signal.SIGINT, signal.SIGTERM)
END_S: Final = limit(
    4.5, "s", "deadlines", "SIGTERM and SIGINT", "anything", "to the end of the process", "SIGALRM ends it"
)


@contextmanager
def signals_to(on_signal: Callable[[signal.Signals], None]) -> Iterator[None]:
    """Call a function for each SIGINT and SIGTERM, in a thread of its own.

    Python runs the handler of a signal between two steps of the main thread. The main thread can wait in a library at
    that time, or hold the lock of the event that the handler sets. A thread that reads the signals does not depend on
    it. Outside the main thread, which alone can install handlers, no signal is read.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    reader, writer = socket.socketpair()
    writer.settimeout(0)

    def read_signals() -> None:
        while number := reader.recv(1):
            if number[0] in _NUMBERS:
                on_signal(signal.Signals(number[0]))

    thread = threading.Thread(target=read_signals, name="signals", daemon=True)
    thread.start()
    before = {number: signal.signal(number, lambda *_: None) for number in _NUMBERS}
    fd_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(fd_before)
        for number, handler in before.items():
            signal.signal(number, handler)
        writer.close()
        thread.join()
        reader.close()


@contextmanager
def stop_on_signals(exit_after_s: float = END_S) -> Iterator[threading.Event]:
    """Return an event that SIGINT and SIGTERM set, so that a command can clean up before it ends.

    Args:
        exit_after_s: Time after the signal at which the process is ended if it runs inside this context.
    """
    stop = threading.Event()

    def on_signal(_number: signal.Signals) -> None:
        signal.setitimer(signal.ITIMER_REAL, exit_after_s)
        stop.set()

    with signals_to(on_signal):
        try:
            yield stop
        finally:
            if stop.is_set():
                signal.setitimer(signal.ITIMER_REAL, 0)


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
