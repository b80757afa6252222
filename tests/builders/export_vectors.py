"""Write missing golden files of the exports: `PYTHONPATH=tests python -m builders.export_vectors`."""

import sys
import tempfile
from pathlib import Path

from builders.common import GOLDEN_FOLDER
from builders.exports import MISSIONS, golden_files
from sonarpost.export.contacts import load_contacts

FOLDER = GOLDEN_FOLDER / "export"

if __name__ == "__main__":
    for mission, write in MISSIONS.items():
        with tempfile.TemporaryDirectory() as folder:
            for name, data in golden_files(mission, load_contacts(write(Path(folder)))).items():
                path = FOLDER / name
                if not path.exists():
                    path.write_bytes(data)
                elif path.read_bytes() != data:
                    sys.exit(f"{path}: output differs; golden files never change, write the new output to a new name")
