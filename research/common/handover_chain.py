"""One chain of `sonarpost demo`, counted or timed; `research.handover_counts` runs it with the sources of a tree."""

import json
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import zenoh
from typing_extensions import override

from sonarpost import keys
from sonarpost.extensions.simulation.demo.chain import Chain
from sonarpost.extensions.simulation.demo.settings import ROUTER_PORTS, VESSEL, ChainSettings, reserved_ports
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.messages import Record
from sonarpost.sonar.image_files import write_png

R = TypeVar("R", bound=Record)

HOOK = Path(__file__).with_name("handover_hook.py")
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


def deposit_survey(settings: ChainSettings, survey: Path) -> None:
    """Put a copy of a survey into the folder that the vehicle polls."""
    hidden = settings.incoming / f".{survey.name}"
    shutil.copyfile(survey, hidden)
    hidden.rename(settings.incoming / survey.name)


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


def measure(folder: Path, contacts: int, survey: Path) -> dict[str, dict[str, float]]:
    """Run one chain; return the figures of each service and contact.

    Args:
        folder: New folder of the chain.
        contacts: Number of snippets to time; 0 to count with the survey.
        survey: File of a survey.
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
                deposit_survey(settings, survey)
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


if __name__ == "__main__":
    print(json.dumps(measure(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))))
