"""Machine code for another processor gives the same bytes and pixels.

emb is compiled for the processor it runs on. Here its golden streams are written and read by machine code for a plain
x86-64 (or aarch64) without vector extensions, compiled anew into a cache of its own. `arm64/run.sh` does the
same on an emulated aarch64, for all codecs.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from builders.common import REPOSITORY

ROOT = REPOSITORY


@pytest.mark.timeout(900)  # it compiles everything anew: 15 s of an idle machine
def test_embs_golden_streams_hold_with_machine_code_for_a_generic_processor(tmp_path: Path) -> None:
    environment = os.environ | {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "OMP_NUM_THREADS": "1",
    }
    told = subprocess.run(
        [sys.executable, "-c", "import numba; print(numba.config.CPU_NAME)"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert told.stdout.strip() == "generic"
    tests = [str(path) for path in sorted((ROOT / "tests" / "codec" / "emb").glob("test_*.py"))]
    assert tests
    options = ["--noconftest", "-p", "no:cacheprovider", "-q", "-o", "timeout=900", "-k", "golden_streams"]
    found = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests],
        env=environment,
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert found.returncode == 0, found.stdout[-3000:] + found.stderr[-1000:]
    assert re.search(r"\b[1-9]\d* passed", found.stdout)
    assert list(tmp_path.rglob("*.nbc"))  # machine code was made here, not taken from another cache
