"""Compilation of codec functions to machine code with numba, stored on disk (see `sonarpost.codec.code_cache`).

Importing numba takes about a second. Import modules that use `jit` at definition only when an image is coded. Without
numba, the functions are those of `sonarpost.codec.compiled_library`.
"""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final, ParamSpec, TypeVar, cast

from sonarpost.codec import compiled_library

P = ParamSpec("P")
R = TypeVar("R")

COMPILE_S: Final = {"emb": 10}
"""Approximate time to compile all functions of a codec."""

NO_FOLDER: Final = "no folder for it is writable; set NUMBA_CACHE_DIR or run `sonarpost prepare` as the installing user"
"""Why the machine code stays in memory."""

service_folders: Final[list[Path]] = []
"""Folders of `use_code_folder`."""

compiled_functions: Final[list[Any]] = []
"""The results of `jit` in this process, for `packaging/compile_codecs.py`."""

log = logging.getLogger(__name__)


def use_code_folder(state_dir: Path) -> None:
    """Let this process store machine code in `machine-code` of a folder if it cannot write beside the modules.

    Call it before an image is coded. Other users must not be able to write there: the files are executed.

    Args:
        state_dir: The folder, created when it is needed. `CACHE_DIRECTORY`, which systemd sets, replaces it.
    """
    folder = Path(os.environ.get("CACHE_DIRECTORY") or state_dir) / "machine-code"
    if folder not in service_folders:
        service_folders.append(folder)


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function`, compiled on its first call.

    Each combination of argument types is compiled separately, and each function again within its callers. Literal
    arguments and mixed integer types in compiled code therefore multiply the compile time. A division by zero does not
    raise an exception.

    A cached function is compiled again when a module with compiled functions in the same folder changes. Compiled
    functions therefore use only functions and constants of such modules.

    Raises:
        ModuleNotFoundError: Neither numba nor the compiled library is installed.
    """
    if compiled_library.is_needed():
        return cast(Callable[P, R], compiled_library.library_function(function))
    compiled = _numba().njit(error_model="numpy", no_cfunc_wrapper=True)(function)
    # numba has no public way to choose the cache; the attribute has had this name since 2016.
    compiled._cache = importlib.import_module("sonarpost.codec.code_cache").CodeCache(function)  # noqa: SLF001
    compiled_functions.append(compiled)
    return cast(Callable[P, R], compiled)


def inlined(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function`, compiled as a part of each function that calls it; for small ones or single calls."""
    if compiled_library.is_needed():
        return function  # the callers in the library contain it
    return cast(Callable[P, R], _numba().njit(error_model="numpy", inline="always")(function))


class CompilationLog:
    """Counts the functions that were compiled because the cache did not hold them; logs the first one of each codec.

    Attributes:
        compiled: Number of functions compiled in this process.
        cache_folders: Folders with the machine code of the compiled functions; empty without a writable folder.
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
        folder = dispatcher.stats.cache_path
        if folder is not None:
            self.cache_folders.add(Path(folder))
        if codec not in self._announced:
            self._announced.add(codec)
            often = "once for each installation" if folder else f"in each process: {NO_FOLDER}"
            # A warning, so that it is visible in a program without a logging configuration.
            log.warning("Preparing machine code for the %s codec: about %d s, %s", codec, COMPILE_S[codec], often)


compilation_log = CompilationLog()


@cache
def _numba() -> ModuleType:
    event = importlib.import_module("numba.core.event")
    event.Listener.register(CompilationLog)
    event.register("numba:compile", compilation_log)
    return importlib.import_module("numba")
