"""Writes golden files of the exports that are not there yet: `python tests/golden/export/write.py` from the root."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path[:0] = [str(FOLDER.parents[1]), str(FOLDER.parents[2])]

from export.make import golden_files, mission  # noqa: E402  # the line above makes it importable

from sonarpost.export.accepted import load_accepted  # noqa: E402

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for name, data in golden_files(load_accepted(mission(Path(folder)))).items():
            path = FOLDER / name
            if not path.exists():
                path.write_bytes(data)
            elif path.read_bytes() != data:
                sys.exit(
                    f"{path} would come out otherwise: a golden file is never changed, give the new one a new name"
                )
