"""Encodings, commits and processor time of one contact on its way from the vehicle to the shore site.

    python -m research.handover_counts [--contacts 40] [--old CHECKOUT] [--json]

It runs the chain of `sonarpost demo` twice, without losses. The first chain gets a simulated survey of six contacts,
and its processes count, for each contact:

- encodes, decodes: records that are packed to msgpack, and that are unpacked and validated;
- unpacked: records of which only some fields are read, for a log line or an acknowledgement;
- commits: transactions of SQLite that change rows; fsyncs: calls of `os.fsync` and `os.fdatasync`.

Health, states, frames for watchers and the start of the services are left out. The images of the second chain are
snippets of 80 x 140 px, as many as `--contacts`. From their arrival until c2 has stored all, the processor time of each
service is measured, without the codec (coding_ms) and without what the idle chain needs in the same time.

With `--old`, the sources of another checkout are measured in turn with these, and the ratios are printed.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from research.common import handover_chain
from research.common.handover_chain import COUNTERS, SERVICES
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf

ROOT = Path(__file__).resolve().parents[1]


def run(root: Path, contacts: int) -> dict[str, dict[str, float]]:
    """Run one chain with the sources of a checkout, in a process of its own; return the figures of each service.

    Args:
        root: The checkout.
        contacts: Number of snippets to time; 0 to count with a simulated survey of six contacts.
    """
    with tempfile.TemporaryDirectory(prefix="handover.") as folder:
        survey = Path(folder) / "simulated.xtf"
        write_xtf(simulate_survey(SurveySpec(seed=1, seabed=SeabedKind.SAND, targets=6, clutter=6)).survey, survey)
        command = [sys.executable, handover_chain.__file__, f"{folder}/run", str(contacts), str(survey)]
        environment = {**os.environ, "PYTHONPATH": f"{root / 'common'}{os.pathsep}{root}"}
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    found: dict[str, dict[str, float]] = json.loads(done.stdout.splitlines()[-1])
    return found


def figures_of(root: Path, contacts: int) -> dict[str, dict[str, float]]:
    """Return counts and times of each service, and their sums."""
    found = run(root, 0)
    for service, values in run(root, contacts).items():
        found[service] |= values
    names = (*COUNTERS[:-1], "cpu_ms", "coding_ms")
    figures = {service: {name: found[service].get(name, 0.0) for name in names} for service in SERVICES}
    figures["sum"] = {name: sum(values[name] for values in figures.values()) for name in names}
    return figures


def print_table(figures: Mapping[str, Mapping[str, float]]) -> None:
    """Print the figures of each service and contact."""
    names = list(figures["sum"])
    print(f"{'for one contact':<16}" + "".join(f"{name:>10}" for name in names))
    for service, values in figures.items():
        print(f"{service:<16}" + "".join(f"{values[name]:>10.1f}" for name in names))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m research.handover_counts", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--contacts", type=int, default=40, help="snippets whose processor time is measured")
    parser.add_argument("--old", type=Path, metavar="CHECKOUT", help="sources to compare with")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parsed = parser.parse_args(arguments)
    roots = {"new": ROOT} if parsed.old is None else {"old": parsed.old.resolve(), "new": ROOT}
    found = {name: figures_of(root, parsed.contacts) for name, root in roots.items()}
    if parsed.json:
        print(json.dumps(found))
        return 0
    for name, figures in found.items():
        print(f"{name}: {roots[name]}")
        print_table(figures)
    if parsed.old is not None:
        ratios = {name: value / found["old"]["sum"][name] for name, value in found["new"]["sum"].items()}
        print("new / old: " + ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
