"""An installation that its user cannot write, and a user without a home folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from builders.common import REPOSITORY

NOBODY = 65534
# The interpreter may be in the home folder of root. The capability permits reading files, not writing them.
AS_NOBODY = (
    *("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"),
    *("--inh-caps=-all,+dac_read_search", "--ambient-caps=-all,+dac_read_search"),
)


class Installation:
    """A copy of the package without machine code, which the user of `command` cannot write."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._prefix = AS_NOBODY if os.getuid() == 0 else ()
        copied = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / "common" / "sonarpost", folder / "sonarpost", ignore=copied)
        self.protect()

    def protect(self) -> None:
        for path in [self._folder, *self._folder.rglob("*")]:
            path.chmod(0o555 if path.is_dir() else 0o444)

    def environment(self, **extra: str) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        return {**kept, "HOME": "/nonexistent", "PYTHONPATH": str(self._folder), "OMP_NUM_THREADS": "1", **extra}

    def command(self, *arguments: str) -> list[str]:
        return [*self._prefix, sys.executable, *arguments]

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = self.environment()
        command = self.command(*arguments)
        return subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=400)

    def machine_code(self) -> list[Path]:
        return list(self._folder.rglob("*.nbc"))


@pytest.fixture
def installation() -> Iterator[Installation]:
    if os.getuid() == 0:
        probe = [*AS_NOBODY, sys.executable, "-c", "import os; os.mkdir('/nonexistent')"]
        if (
            shutil.which("setpriv") is None
            or b"PermissionError" not in subprocess.run(probe, check=False, capture_output=True).stderr
        ):
            pytest.skip("cannot run the interpreter as user nobody: setpriv is missing or has no capability to pass on")
    with tempfile.TemporaryDirectory() as name:
        installed = Installation(Path(name))
        yield installed
        for folder in [Path(name), *Path(name).rglob("*")]:
            if folder.is_dir():
                folder.chmod(0o755)
