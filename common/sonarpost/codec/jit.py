"""Compilation of codec functions to machine code with numba, cached on disk.

Importing numba takes about a second. Import modules that use `jit` at definition only when an image is coded.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final, ParamSpec, TypeVar, cast

P = ParamSpec("P")
R = TypeVar("R")

COMPILE_S: Final = {"emb": 20, "vq": 2}
"""Approximate time to compile all functions of a codec."""

log = logging.getLogger(__name__)


def jit(function: Callable[P, R], *, reorder_sums: bool = False) -> Callable[P, R]:
    """Return `function`, compiled on its first call.

    numba recompiles a cached function only when its own source file changes. Compiled functions therefore call only
    functions of their own module. With `reorder_sums`, the compiler may reorder sums of floating-point numbers.
    """
    flags = {"reassoc", "contract", "nnan", "nsz"} if reorder_sums else False
    return cast(Callable[P, R], _numba().njit(cache=True, fastmath=flags)(function))


class CompilationLog:
    """Counts the functions that were compiled because the cache did not hold them; logs the first one of each codec.

    Attributes:
        compiled: Number of functions compiled in this process.
        cache_folders: Folders with the machine code of the compiled functions.
    """

    def __init__(self) -> None:
        self.compiled = 0
        self.cache_folders: set[Path] = set()
        self._announced: set[str] = set()

    def notify(self, event: Any) -> None:  # noqa: ANN401 numba has no types
        """Handle an event of numba: the start or the end of a compilation."""
        dispatcher = event.data["dispatcher"]
        names = dispatcher.py_func.__module__.split(".")
        codec = next((name for name in COMPILE_S if names[:3] == ["sonarpost", "codec", name]), None)
        if codec is None or not event.is_start:
            return
        self.compiled += 1
        self.cache_folders.add(Path(dispatcher.stats.cache_path))
        if codec not in self._announced:
            self._announced.add(codec)
            seconds = COMPILE_S[codec]
            # A warning, so that it is visible in a program without a logging configuration.
            log.warning(
                "Preparing machine code for the %s codec: about %d s, once for each installation", codec, seconds
            )


compilation_log = CompilationLog()


@cache
def _numba() -> ModuleType:
    event = importlib.import_module("numba.core.event")
    event.Listener.register(CompilationLog)
    event.register("numba:compile", compilation_log)
    return importlib.import_module("numba")
