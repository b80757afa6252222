"""Builds the wheel and checks what is in it: everything that runs, nothing that does not."""

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]


def wanted() -> set[str]:
    """Return the files of the source tree that belong into the wheel."""
    files = {p.relative_to(REPOSITORY / "common").as_posix() for p in (REPOSITORY / "common" / "sonarpost").rglob("*")}
    files |= {f"sonarpost/{p.relative_to(REPOSITORY).as_posix()}" for p in (REPOSITORY / "services").rglob("*")}
    files |= {f"sonarpost/cli/deployment/examples/{p.name}" for p in (REPOSITORY / "config").iterdir()}
    suffixes = (
        ".py",
        ".typed",
        ".tiles",
        ".model",
        ".json",
        ".json5",
        ".toml",
        ".service",
        ".target",
        ".conf",
        ".md",
        ".html",
        ".css",
        ".js",
        ".svg",
    )
    return {name for name in files if name.endswith(suffixes) and "__pycache__" not in name}


def main() -> int:
    """Return 0 when the wheel holds exactly what it should."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, str(REPOSITORY)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (wheel,) = Path(folder).glob("*.whl")
        with zipfile.ZipFile(wheel) as archive:
            names = set(archive.namelist())
    missing = wanted() - names
    top_level = {"sonarpost"} | {name.partition("/")[0] for name in names if ".dist-info/" in name}
    extra = {name for name in names if name.partition("/")[0] not in top_level or "__pycache__" in name}
    vendor = "sonarpost/services/console/static/vendor/leaflet/"
    missing |= {vendor + name for name in ("leaflet.js", "leaflet.css", "LICENSE.md")} - names
    licence = any(name.endswith("licenses/LICENSE") for name in names)
    for problem, which in (("missing from", missing), ("does not belong into", extra)):
        for name in sorted(which):
            print(f"{name}: {problem} the wheel")
    if not licence:
        print("LICENSE: missing from the wheel")
    if missing or extra or not licence:
        return 1
    print(f"{wheel.name}: {len(names)} files, as they should be")
    return 0


if __name__ == "__main__":
    sys.exit(main())
