"""Write a software bill of materials (CycloneDX, JSON): python packaging/sbom.py ENVIRONMENT LOCK OUTPUT.

ENVIRONMENT is a virtual environment with the packages of LOCK and nothing else. Exit status 1: the document does not
list the packages of LOCK in the same versions. The product is the main component of the document, not a package.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

Packages = set[tuple[str, str]]


def normalised(name: str) -> str:
    """Return the name of a package as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def locked(text: str) -> Packages:
    """Return name and version of each package in a lock file."""
    return {(normalised(name), version) for name, version in re.findall(r"^([\w.-]+)==([^\s;\\]+)", text, re.MULTILINE)}


def listed(text: str) -> Packages:
    """Return name and version of each component in a CycloneDX document."""
    return {(normalised(part["name"]), part["version"]) for part in json.loads(text)["components"]}


def differences(lock: Packages, sbom: Packages) -> list[str]:
    """Return one line for each package that only one of the two lists."""
    missing = [f"{name} {version}: in the lock file only" for name, version in sorted(lock - sbom)]
    return missing + [f"{name} {version}: in the bill of materials only" for name, version in sorted(sbom - lock)]


def write(environment: str, output: Path) -> None:
    """Write the document; the version of the product is not in pyproject.toml."""
    root = Path(__file__).parents[1]
    command = [sys.executable, "-m", "cyclonedx_py", "environment", "--pyproject", str(root / "pyproject.toml")]
    command.append(environment)
    text = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout  # noqa: S603 a fixed command
    document = json.loads(text)
    [version] = re.findall(r'^__version__ = "(.+)"$', (root / "common/sonarpost/__init__.py").read_text(), re.MULTILINE)
    document["metadata"]["component"]["version"] = version
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(document, indent=2) + "\n")


def main() -> int:
    """Write the document; print the differences, or the number of packages."""
    environment, lock, output = sys.argv[1:]
    write(environment, Path(output))
    expected = locked(Path(lock).read_text())
    found = differences(expected, listed(Path(output).read_text()))
    print("\n".join(found) or f"{output}: {len(expected)} packages, the same as in {lock}")
    return int(bool(found) or not expected)


if __name__ == "__main__":
    sys.exit(main())
