"""Storage of the codecs' machine code: numba's cache files, in the first suitable folder of several.

numba itself uses a folder only if it can write there, and raises an exception if it finds none. Here, prepared code is
loaded from a read-only installation, and without a writable folder the code stays in memory. This module imports numba.
"""

from __future__ import annotations

import hashlib
import inspect
import logging
import os
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba.core import caching

from sonarpost.codec import jit

log = logging.getLogger(__name__)


def code_folders(source: Path) -> list[Path]:
    """Return the folders for the machine code of a module, in the order in which they are tried.

    `__pycache__` beside the module, the service's state folder and the user's cache folder; only the folder of
    NUMBA_CACHE_DIR if that is set. They need not exist.
    """
    # As in numba: a subfolder for each source folder, so that several installations can share a cache folder.
    name = f"{source.parent.name}_{hashlib.sha256(os.fsencode(source.parent)).hexdigest()[:16]}"
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return [Path(chosen) / name]
    user = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111 Path raises without a home
    users = [user / "sonarpost"] if user.is_absolute() else []
    return [source.parent / "__pycache__", *(folder / name for folder in (*jit.service_folders, *users))]


class CodeCache:
    """The cache of one compiled function, with the methods that a numba dispatcher calls.

    Args:
        function: The Python function.
    """

    def __init__(self, function: Callable[..., object]) -> None:
        self._function = function
        self._folders = code_folders(Path(inspect.getfile(function)))

    @property
    def cache_path(self) -> str | None:
        """The first writable folder; None without one."""
        return next((str(folder) for folder in self._folders if _is_writable(folder)), None)

    def load_overload(self, signature: Any, target_context: Any) -> Any:  # noqa: ANN401 numba has no types
        """Return the machine code for a signature from the first folder that holds it; None without one."""
        for folder in self._folders:
            try:
                code = _open(self._function, folder).load_overload(signature, target_context)
            except OSError as error:
                log.debug("Machine code in %s is not accessible: %s", folder, error)
                continue
            except Exception as error:  # noqa: BLE001 damaged pickles raise many types
                # For example after a power cut while the file was written.
                log.warning("Machine code in %s cannot be read; it is compiled again: %r", folder, error)
                continue
            if code is not None:
                return code
        return None

    def save_overload(self, signature: Any, code: Any) -> None:  # noqa: ANN401 numba has no types
        """Store the machine code for a signature in the first writable folder; keep it in memory without one."""
        folder = self.cache_path
        if folder is None:
            return
        files = _open(self._function, Path(folder))
        try:
            try:
                files.save_overload(signature, code)
            except Exception:  # noqa: BLE001 a damaged index, see load_overload
                files.flush()
                files.save_overload(signature, code)
        except OSError as error:
            log.warning("Machine code cannot be stored in %s: %s", folder, error)

    def flush(self) -> None:
        """Remove the stored machine code, as `recompile` of a dispatcher requires."""
        for folder in filter(_is_writable, self._folders):
            _open(self._function, folder).flush()


def _open(function: Callable[..., object], folder: Path) -> Any:  # noqa: ANN401 numba has no types
    """Return numba's cache of a function in a folder, whether it is writable or not."""

    class Locator:
        """Where numba stores a function, and how it recognises that the source has changed."""

        from_function = staticmethod(lambda _function, _source: Locator())
        ensure_cache_path = staticmethod(lambda: None)
        get_cache_path = staticmethod(lambda: str(folder))
        get_source_stamp = staticmethod(lambda: _digest(Path(inspect.getfile(function)).parent))
        get_disambiguator = staticmethod(lambda: str(function.__code__.co_firstlineno))

    implementation = type("Implementation", (caching.CompileResultCacheImpl,), {"_locator_classes": [Locator]})
    return type("FolderCache", (caching.FunctionCache,), {"_impl_class": implementation})(function)


@cache
def _digest(folder: Path) -> bytes:
    """Return the digest of all modules of the folder with compiled functions, which call one another."""
    sources = [path.read_bytes() for path in sorted(folder.glob("*.py"))]
    compiled = [source for source in sources if b"from sonarpost.codec.jit import" in source]
    return hashlib.sha256(b"".join(hashlib.sha256(source).digest() for source in compiled)).digest()


@cache
def _is_writable(folder: Path) -> bool:
    """Whether a file can be created in the folder; create a missing folder."""
    try:
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
