"""All processes, the link, the clocks and the disks fail at random; the history checker decides.

`SONARPOST_CHAOS_S` sets the duration of the faults (60 s), `SONARPOST_CHAOS_SEED` the seed.
`SONARPOST_CHAOS_OUT` names a folder in which the operation log and the table of faults are kept.
"""

import json
import os
import shutil
import time
from collections import Counter
from pathlib import Path

import pytest
from builders.chaos import CLOCKS, DISKS, PROCESSES, chaos_chain, plan_faults
from builders.numbered_snippet import number_of, numbered_snippet

DURATION_S = float(os.environ.get("SONARPOST_CHAOS_S", "60"))
SEED = int(os.environ.get("SONARPOST_CHAOS_SEED", "20261122"))
KINDS = ("SIGKILL", "SIGTERM", "SIGSTOP", "cut", "stall", "reset", "step", "full")


def test_plan_follows_from_the_seed_and_covers_every_target():
    plan = plan_faults(7, 1800.0)
    assert plan == plan_faults(7, 1800.0)
    assert plan != plan_faults(8, 1800.0)
    platforms = (*(f"clock {name}" for name in CLOCKS), *(f"disk {name}" for name in DISKS))
    assert {fault.target for fault in plan} == {*PROCESSES, "link", *platforms}
    assert {fault.kind for fault in plan} == set(KINDS)


def test_number_of_a_snippet_is_read_from_its_pixels():
    for number in (0, 1, 1234, 65535):
        assert number_of(numbered_snippet(number)) == number
    damaged = numbered_snippet(1234)
    damaged[:16, :16] = 255 - damaged[:16, :16]
    assert number_of(damaged) is None


@pytest.mark.timeout(2 * DURATION_S + 1800)
def test_random_faults_everywhere_lose_duplicate_and_change_nothing(tmp_path):
    name = f"SONARPOST_CHAOS_SEED={SEED} SONARPOST_CHAOS_S={DURATION_S:g}"
    with chaos_chain(tmp_path / "run") as chaos:
        chaos.history.fault("plan", name)
        try:
            chaos.run(plan_faults(SEED, DURATION_S), DURATION_S)
            repaired_s = time.monotonic()
            before = chaos.complete_snippets()
            chaos.wait_until_delivered()
            print(table(chaos, before, time.monotonic() - repaired_s))
        finally:
            if (kept := os.environ.get("SONARPOST_CHAOS_OUT")) is not None:
                keep(chaos, Path(kept))
        verdict = chaos.history.verdict()
        assert verdict.ok, f"{name}: {verdict}"
        assert verdict.queued == chaos.snippets + chaos.images > 0


def table(chaos, before, repair_s):
    """Return the result of a run as text."""
    lines = [
        f"seed {SEED}, faults for {DURATION_S:.0f} s, delivered {repair_s:.0f} s after the repair",
        f"{chaos.snippets} snippets from the vehicle's folder, {before} complete at the shore before the repair",
        f"{chaos.images} images from an outbox",
        str(chaos.history.verdict()),
    ]
    for kind in KINDS:
        counts = Counter({target: n for (target, k), n in chaos.counts.injected.items() if k == kind})
        lines.append(f"{kind:8} {counts.total():4}  " + ", ".join(f"{t} {n}" for t, n in sorted(counts.items())))
    ended = ", ".join(f"{name} status {status}: {n}" for (name, status), n in sorted(chaos.counts.ended_alone.items()))
    return "\n".join([*lines, f"ended without a signal: {ended or 'none'}", *chaos.counts.skipped])


def keep(chaos, folder):
    """Copy the operation log and the logs of all processes."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(chaos.history.path, folder / f"history-{SEED}.jsonl")
    shutil.copytree(chaos.settings.folder / "logs", folder / f"logs-{SEED}", dirs_exist_ok=True)
    injected = {f"{target} {kind}": n for (target, kind), n in chaos.counts.injected.items()}
    (folder / f"counts-{SEED}.json").write_text(json.dumps(injected, indent=1))
