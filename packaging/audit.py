"""Look up known vulnerabilities of locked packages with pip-audit: python packaging/audit.py LOCK...

Exit status 1: a package has a known vulnerability. A package that the service does not answer for, or a service that is
not reached, is printed and leaves the exit status at 0.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

OPTIONS = ("--disable-pip", "--require-hashes", "--progress-spinner=off", "--timeout=20", "--format=json")


def report(dependencies: Iterable[Mapping[str, Any]]) -> tuple[list[str], bool]:
    """Return the lines to print for the dependencies in pip-audit's report, and whether one is vulnerable."""
    known = list(dependencies)
    audited = [entry for entry in known if "skip_reason" not in entry]
    vulnerable = [entry for entry in audited if entry["vulns"]]
    lines = [
        f"{entry['name']} {entry['version']}: {found['id']}, fixed in {' '.join(found['fix_versions']) or 'no version'}"
        for entry in vulnerable
        for found in entry["vulns"]
    ]
    lines.append(f"{len(audited)} of {len(known)} packages audited, {len(vulnerable)} with known vulnerabilities")
    if skipped := [entry["name"] for entry in known if "skip_reason" in entry]:
        lines.append(f"NOT AUDITED, no data for: {', '.join(skipped)}")
    return lines, bool(vulnerable)


def audit(lock: str) -> bool:
    """Print the report on a lock file; return whether a package is vulnerable."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "audit.json"
        command = [sys.executable, "-m", "pip_audit", "--requirement", lock, "--output", str(answer), *OPTIONS]
        done = subprocess.run(command, check=False, capture_output=True, text=True)  # noqa: S603 a fixed command
        if not answer.exists() or not answer.read_text():
            last = done.stderr.strip().splitlines()[-1:] or ["no output"]
            print(f"{lock}: NOT AUDITED, the vulnerability service is not reached: {last[0]}")
            return False
        lines, vulnerable = report(json.loads(answer.read_text())["dependencies"])
    print("\n".join(f"{lock}: {line}" for line in lines))
    return vulnerable


def main() -> int:
    """Audit each lock file."""
    vulnerable = [audit(lock) for lock in sys.argv[1:]]  # all of them, also after the first finding
    return int(any(vulnerable))


if __name__ == "__main__":
    sys.exit(main())
