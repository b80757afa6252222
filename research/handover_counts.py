"""Encodings, commits and processor time of one contact on its way from the vehicle to the shore site.

    python -m research.handover_counts [--contacts 40]

It runs the chain of `sonarpost demo` twice, without losses. The first chain gets a simulated survey of six contacts,
and its processes count, for each contact:

- encodes, decodes: records that are packed to msgpack, and that are unpacked and validated;
- unpacked: records of which only some fields are read, for a log line or an acknowledgement;
- commits: transactions of SQLite that change rows; fsyncs: calls of `os.fsync` and `os.fdatasync`.

Health, states, frames for watchers and the start of the services are left out. The images of the second chain are
snippets of 80 x 140 px, as many as `--contacts`. From their arrival until c2 has stored all, the processor time of each
service is measured, without the codec (coding_ms) and without what the idle chain needs in the same time.
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import zenoh
from typing_extensions import override

from sonarpost import keys
from sonarpost.extensions.simulation.demo.chain import Chain
from sonarpost.extensions.simulation.demo.settings import ROUTER_PORTS, VESSEL, ChainSettings, reserved_ports
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.messages import Record
from sonarpost.sonar.image_files import write_png

R = TypeVar("R", bound=Record)

HOOK = Path(__file__).parent / "common" / "handover_hook.py"
COUNTERS = ("encodes", "decodes", "unpacked", "commits", "fsyncs", "coding_ns")
"""In the order of the files that the hook writes."""
SERVICES = ("atd_stub", "compressor", "uuv_modem", "op_modem", "decompressor", "relay", "c2")
WORKERS = {"decode_worker": "c2"}
IDLE_S = 4.0
QUIET_S = 1.5
TIMEOUT_S = 300.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class ShoreWatcher(Watcher):
    """Watches the chain without a subscription to the vessel's pixels, which would be encoded for it alone."""

    @override
    def _subscribe(self, session: zenoh.Session, key: str, record_type: type[R], take: Callable[[R], None]) -> None:
        if key != keys.image_reconstructed(VESSEL):
            super()._subscribe(session, key, record_type, take)


def snippet(number: int) -> npt.NDArray[np.uint8]:
    """Return an image of seabed with a highlight and a shadow, shape (80, 140)."""
    rng = np.random.default_rng(number)
    image = rng.gamma(4.0, 25.0, (80, 140))
    image[30:44, 50:60] += 120
    image[32:42, 60:100] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def deposit_survey(settings: ChainSettings) -> None:
    """Put a simulated survey of six contacts into the folder that the vehicle polls."""
    hidden = settings.incoming / ".simulated.xtf"
    write_xtf(simulate_survey(SurveySpec(seed=1, seabed=SeabedKind.SAND, targets=6, clutter=6)).survey, hidden)
    hidden.rename(settings.incoming / hidden.name[1:])


def deposit_snippets(settings: ChainSettings, contacts: int) -> None:
    """Put images into the folder that the vehicle polls."""
    for number in range(contacts):
        hidden = settings.incoming / f".snippet-{number:03}.png"
        write_png(hidden, snippet(number))
        hidden.rename(settings.incoming / hidden.name[1:])


def wait_until_idle(chain: Chain, watcher: Watcher, files: int) -> None:
    """Wait until all files have been processed and all images are complete at the shore site."""
    deadline_s, idle_since_s = time.monotonic() + TIMEOUT_S, 0.0
    while not idle_since_s or time.monotonic() - idle_since_s < QUIET_S:
        chain.check()
        if watcher.busy(files, time.time() - 2.0) or not watcher.encoded:
            idle_since_s = 0.0
        idle_since_s = idle_since_s or time.monotonic()
        if time.monotonic() > deadline_s:
            sys.exit(f"not idle within {TIMEOUT_S:.0f} s: {watcher.busy(files, time.time() - 2.0)}")
        time.sleep(0.05)


def cpu_s(pid: int) -> float:
    """Return the processor time of a process and its child processes."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    others = [p for p in Path(f"/proc/{pid}/task").glob("*/children") if p.parent.name != str(pid)]
    children += [child for path in others for child in path.read_text().split()]
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S + sum(cpu_s(int(child)) for child in children)


def counted(folder: Path) -> dict[str, Counter[str]]:
    """Return the counters of each service."""
    found = {service: Counter[str]() for service in SERVICES}
    for path in folder.iterdir():
        name = path.name.partition(".")[0]
        values = np.fromfile(path, "<u8")
        if (service := WORKERS.get(name, name)) in found:
            found[service] += Counter(dict(zip(COUNTERS, map(int, values), strict=True)))
    return found


def measure(folder: Path, contacts: int) -> dict[str, dict[str, float]]:
    """Run one chain; return the figures of each service and contact.

    Args:
        folder: New folder of the chain.
        contacts: Number of snippets to time; 0 to count with a survey.
    """
    counts = folder / "counts"
    counts.mkdir(parents=True)
    hook = folder / "hook"
    hook.mkdir()
    shutil.copyfile(HOOK, hook / "sitecustomize.py")
    os.environ["PYTHONPATH"] = os.pathsep.join((str(hook), os.environ.get("PYTHONPATH", "")))
    os.environ["HANDOVER_COUNTS"] = str(counts)
    if contacts:
        os.environ["HANDOVER_TIMED"] = "1"
    with reserved_ports(*ROUTER_PORTS) as ports:
        settings = ChainSettings(
            folder=folder / "chain",
            mode="snippets" if contacts else "survey",
            time_scale=40.0,
            router_ports=(ports[0], ports[1], ports[2]),
        )
        with Chain(settings) as chain, ShoreWatcher(settings, chain.check) as watcher:
            watcher.wait_until_started()
            if not contacts:
                before = counted(counts)
                deposit_survey(settings)
                wait_until_idle(chain, watcher, 1)
                found, after = len(watcher.shore), counted(counts)
                totals = {name: {k: float(after[name][k] - before[name][k]) for k in COUNTERS} for name in SERVICES}
            else:
                totals, found = _times(chain, watcher, settings, counts, contacts), contacts
            if not watcher.all_complete or not found:
                sys.exit("images are missing at the shore site")
    return {service: {name: value / found for name, value in of.items()} for service, of in totals.items()}


def _times(
    chain: Chain, watcher: Watcher, settings: ChainSettings, counts: Path, contacts: int
) -> dict[str, dict[str, float]]:
    """Return the processor time of each service in ms, without that of an idle chain, and the codec's."""

    def used_by(step: Callable[[], object]) -> tuple[float, dict[str, float], dict[str, float]]:
        began_s, coding, before = time.monotonic(), counted(counts), {n: cpu_s(chain.pid(n)) for n in SERVICES}
        step()
        after, coding_after = {n: cpu_s(chain.pid(n)) for n in SERVICES}, counted(counts)
        coding_s = {n: (coding_after[n]["coding_ns"] - coding[n]["coding_ns"]) * 1e-9 for n in SERVICES}
        return time.monotonic() - began_s, {n: after[n] - before[n] - coding_s[n] for n in SERVICES}, coding_s

    def send(count: int) -> None:
        deposit_snippets(settings, count)
        wait_until_idle(chain, watcher, count)

    send(1)  # loads codecs and starts the decode worker
    idle_s, idle, _ = used_by(lambda: time.sleep(IDLE_S))
    duration_s, busy, coding_s = used_by(lambda: send(contacts + 1))
    return {
        name: {"cpu_ms": 1000 * (busy[name] - idle[name] * duration_s / idle_s), "coding_ms": 1000 * coding_s[name]}
        for name in SERVICES
    }


def figures_of(contacts: int) -> dict[str, dict[str, float]]:
    """Return counts and times of each service, and their sums."""
    with tempfile.TemporaryDirectory(prefix="handover.") as folder, patch.dict(os.environ):
        found = measure(Path(folder) / "counted", 0)
        for service, values in measure(Path(folder) / "timed", contacts).items():
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
    parsed = parser.parse_args(arguments)
    print_table(figures_of(parsed.contacts))
    return 0


if __name__ == "__main__":
    sys.exit(main())
