"""Machine code for another processor gives the same bytes and pixels.

emb is compiled for the processor of the machine. Here its golden streams are encoded and decoded by machine code for a
generic x86-64 (or aarch64) without vector extensions, compiled into a separate cache. `arm64/run.sh` does the
same on an emulated aarch64, for all codecs.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from builders.common import REPOSITORY


@pytest.mark.system
def test_golden_streams_of_emb_on_a_generic_processor(tmp_path: Path) -> None:
    environment = os.environ | {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "OMP_NUM_THREADS": "1",
    }
    cpu_name = [sys.executable, "-c", "import numba; print(numba.config.CPU_NAME)"]
    assert subprocess.check_output(cpu_name, env=environment, text=True).strip() == "generic"
    tests = [str(path) for path in sorted((REPOSITORY / "tests" / "codec" / "emb").glob("test_*.py"))]
    assert tests
    options = ["--noconftest", "-p", "no:cacheprovider", "-q", "-k", "golden_streams"]
    command = [sys.executable, "-m", "pytest", *options, *tests]
    found = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=REPOSITORY, check=False)
    assert found.returncode == 0, found.stdout[-3000:] + found.stderr[-1000:]
    assert re.search(r"\b[1-9]\d* passed", found.stdout)
    assert list(tmp_path.rglob("*.nbc"))  # compiled here, not taken from another cache
