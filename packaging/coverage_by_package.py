"""Print the coverage of each package and the modules below 70 %: packaging/coverage_by_package.py COVERAGE.json."""

import json
import sys
from collections import defaultdict
from pathlib import Path

LOW_PERCENT = 70.0


def package_of(file: str) -> str:
    """Return the package of a file: `link` of common/sonarpost/link/frames/x.py, `services/relay` of a service."""
    folder = Path(file).parts[:-1]
    return "/".join(folder[:2] if folder[0] == "services" else folder[2:3]) or "sonarpost"


def main() -> None:
    """Read the JSON report of coverage.py and print both tables."""
    files = json.loads(Path(sys.argv[1]).read_text())["files"]
    packages: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    low = []
    for name, report in files.items():
        summary = report["summary"]
        for counts in (packages[package_of(name)], packages["all"]):
            counts[0] += summary["covered_lines"]
            counts[1] += summary["num_statements"]
        if summary["num_statements"] and summary["percent_covered"] < LOW_PERCENT:
            low.append(f"{summary['percent_covered']:5.1f} %  {name}")
    print("coverage by the quick tests, child processes not counted")
    for name, (covered, statements) in sorted(packages.items()):
        print(f"{100 * covered / max(statements, 1):5.1f} %  {covered:6} of {statements:6}  {name}")
    print(f"modules below {LOW_PERCENT:.0f} %:", *sorted(low), sep="\n")


if __name__ == "__main__":
    main()
