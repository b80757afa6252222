"""An installation that its user cannot write, and a user without a home folder."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from builders.common import REPOSITORY

# Root without capabilities cannot write files without the bit for it; it can read an interpreter in its home folder.
UNPRIVILEGED = ("setpriv", "--bounding-set=-all", "--inh-caps=-all")
WRITE = "import sonarpost; open(sonarpost.__file__, 'a')"


class Installation:
    """A copy of the package without machine code, which the user of `command` cannot write."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._prefix = UNPRIVILEGED if os.getuid() == 0 else ()
        copied = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / "common" / "sonarpost", folder / "sonarpost", ignore=copied)
        self.protect()

    def protect(self) -> None:
        for path in [self._folder, *self._folder.rglob("*")]:
            path.chmod(0o555 if path.is_dir() else 0o444)

    def environment(self, **extra: str) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        home = str(self._folder / "no-home")
        return {**kept, "HOME": home, "PYTHONPATH": str(self._folder), "OMP_NUM_THREADS": "1", **extra}

    def command(self, *arguments: str) -> list[str]:
        return [*self._prefix, sys.executable, *arguments]

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = self.environment()
        command = self.command(*arguments)
        return subprocess.run(command, check=False, env=environment, capture_output=True, text=True)

    def machine_code(self) -> list[Path]:
        return list(self._folder.rglob("*.nbc"))


@pytest.fixture
def installation() -> Iterator[Installation]:
    with tempfile.TemporaryDirectory() as name:
        installed = Installation(Path(name))
        refused = installed.run("-c", WRITE)
        if "PermissionError" not in refused.stderr:
            pytest.skip(f"cannot start the interpreter without privileges: {refused.stderr}")
        yield installed
        for folder in [Path(name), *Path(name).rglob("*")]:
            if folder.is_dir():
                folder.chmod(0o755)
