"""Ends a child process together with its parent; the demo starts its services this way."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

EXIT_WITH_PARENT = "SONARPOST_EXIT_WITH_PARENT"
EXIT_ORPHANED = 1
_PR_SET_PDEATHSIG = 1


def exit_with_parent() -> None:
    """End this process when its parent ends, if `SONARPOST_EXIT_WITH_PARENT` holds the parent's process id (Linux)."""
    parent = os.environ.get(EXIT_WITH_PARENT)
    if parent is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):
        # The parent ended before prctl took effect.
        os._exit(EXIT_ORPHANED)
