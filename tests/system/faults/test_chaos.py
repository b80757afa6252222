"""All processes, the link, the clocks and the disks fail at random; the history checker decides.

A plan of faults follows from a seed alone. `ChaosChain` runs all services and routers of vehicle, vessel and shore
site, injects the faults of a plan, starts every process that ended, as a supervisor does, and writes the operation log.
Two sources run all the time. Snippets enter the folder of the vehicle and travel over the acoustic link; each shows its
own number as a pattern of blocks, so that it is identified by its pixels at the end. Images of a second vehicle enter
the relay from a durable outbox.

`SONARPOST_CHAOS_S` sets the duration of the faults (60 s), `SONARPOST_CHAOS_SEED` the seed.
`SONARPOST_CHAOS_OUT` names a folder in which the operation log and the table of faults are kept.
"""

import json
import os
import random
import shutil
import signal
import sqlite3
import sys
import time
from collections import Counter
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import tifffile
from builders.chain import latest_versions, send_signal
from builders.common import REPOSITORY, free_port
from builders.history import History
from builders.image_archive import ArchiveLog, name_of
from builders.image_source import ImageSource, make_image, pixels_sha256
from builders.numbered_snippet import number_of, numbered_snippet
from builders.progress import wait_while_progressing
from builders.small_disk import SmallDisk
from builders.vessel_and_shore import UNFINISHED

from research.common.link_emulator import LinkEmulator
from sonarpost import keys
from sonarpost.config import PlatformConfig
from sonarpost.extensions.simulation.demo.chain import ROUTERS, Chain
from sonarpost.extensions.simulation.demo.settings import PLATFORM_OF, SHORE, UUV, VESSEL, WATER, ChainSettings
from sonarpost.sonar.image_files import write_png

PROCESSES = (*ROUTERS, *PLATFORM_OF)
CLOCKS = (UUV, VESSEL, SHORE, WATER)
DISKS = (UUV, VESSEL, SHORE, "shore images")
DISK_KB = {UUV: 96_000, VESSEL: 128_000, SHORE: 128_000, "shore images": 512_000}
CLOCK_STEPS_S = (-7200.0, -3600.0, -30.0, 30.0, 3600.0, 7200.0)
"""The difference of two is less than the time for which op_modem keeps a contact: see its limits."""
SOURCE_VEHICLE = "uuv-9"
SNIPPET_KEY = "snippet"
IMAGE_KEY = keys.image_coded(VESSEL)
SNIPPET_INTERVAL_S = 4.0
IMAGE_INTERVAL_S = 1.0
STUCK_S = 120.0
"""A process that does not end within this time after SIGTERM is a failure."""


# The plan


@dataclass(frozen=True)
class Fault:
    """A fault of a process, `link`, `clock PLATFORM` or `disk NAME`; `offset_s` is the new offset of a clock."""

    at_s: float
    target: str
    kind: str
    duration_s: float = 0.0
    offset_s: float = 0.0


def plan_faults(seed, seconds):
    """Return faults for a duration, one every 3 s on average; the same arguments return the same plan.

    At most one fault has a target at a time.
    """
    rng = random.Random(seed)
    free_at_s = {}
    faults = []
    at_s = rng.uniform(1.0, 3.0)
    while at_s < seconds:
        fault = _draw(rng, at_s)
        if free_at_s.get(fault.target, 0.0) <= at_s:
            faults.append(fault)
            free_at_s[fault.target] = at_s + fault.duration_s + 0.5
        at_s += rng.uniform(1.0, 5.0)
    return faults


def _draw(rng, at_s):
    kind = rng.choices(("SIGKILL", "SIGTERM", "SIGSTOP", "link", "step", "full"), (35, 10, 20, 15, 10, 10))[0]
    if kind.startswith("SIG"):
        longest_s = 8.0 if kind == "SIGSTOP" else 3.0
        return Fault(at_s, rng.choice(PROCESSES), kind, rng.uniform(0.1, longest_s))
    if kind == "link":
        kind = rng.choice(("cut", "stall", "reset"))
        return Fault(at_s, "link", kind, 0.0 if kind == "reset" else rng.uniform(0.5, 10.0))
    if kind == "step":
        return Fault(at_s, f"clock {rng.choice(CLOCKS)}", "step", 0.0, rng.choice(CLOCK_STEPS_S))
    return Fault(at_s, f"disk {rng.choice(DISKS)}", "full", rng.uniform(1.0, 8.0))


# The chain


class _ClockedChain(Chain):
    """A chain whose services read a clock that is shifted by the number in a file of their platform."""

    def clock(self, platform):
        return self.settings.folder / f"clock-{platform}"

    def command(self, name):
        if name in ROUTERS:
            return super().command(name)
        script = REPOSITORY / "tests" / "builders" / "shifted_clock.py"
        return [sys.executable, str(script), str(self.clock(PLATFORM_OF[name])), *self.module(name)]

    def step(self, platform, offset_s):
        new = self.clock(platform).with_suffix(".new")
        new.write_text(str(offset_s))
        new.replace(self.clock(platform))


@dataclass
class Counts:
    """Faults by (target, kind); processes that ended by themselves, by (name, status); faults that the host forbids."""

    injected: Counter[tuple[str, str]] = field(default_factory=Counter)
    ended_alone: Counter[tuple[str, int]] = field(default_factory=Counter)
    skipped: list[str] = field(default_factory=list)


class ChaosChain:
    def __init__(self, chain, link, disks, history):
        self.chain = chain
        self.settings = chain.settings
        self.history = history
        self.counts = Counts()
        self.snippets = 0
        self.images = 0
        self._link = link
        self._disks = disks
        self._down_until_s = {}
        self._expected_end = set()
        self._ends = []
        self._archive = ArchiveLog(history, self.settings.shore_images.parent, VESSEL, IMAGE_KEY, SOURCE_VEHICLE)
        platform = PlatformConfig(
            id=VESSEL,
            router=(f"tcp/127.0.0.1:{self.settings.router_ports[1]}",),
            state_dir=self.settings.folder / "state" / "source",
        )
        self.source = ImageSource(platform, lambda image: self._log("acknowledged", image))
        assert self.source.start()
        history.add("consumer", "decompressor", key=SNIPPET_KEY)
        history.add("consumer", "c2 files", key=SNIPPET_KEY)
        for consumer in ("c2", "c2 index"):
            history.add("consumer", consumer, key=IMAGE_KEY)

    # Sources

    def feed(self, elapsed_s):
        """Queue the snippets and images that are due."""
        while self.snippets * SNIPPET_INTERVAL_S < elapsed_s:
            hidden = self.settings.incoming / f".snippet-{self.snippets:04}.png"
            write_png(hidden, numbered_snippet(self.snippets))
            hidden.rename(hidden.with_name(hidden.name[1:]))
            self.history.add("queued", "survey folder", f"snippet-{self.snippets:04}", key=SNIPPET_KEY)
            self.snippets += 1
        while self.images * IMAGE_INTERVAL_S < elapsed_s:
            shape = ((24, 32), (60, 80), (150, 300))[self.images % 10 // 4]
            image = make_image(self.images, shape).model_copy(update={"vehicle_id": SOURCE_VEHICLE})
            self.source.send([image])
            self._log("queued", image)
            self.images += 1

    def _log(self, operation, image):
        assert operation in ("queued", "acknowledged")
        self.history.add(operation, "source", name_of(image), key=IMAGE_KEY, sha256=pixels_sha256(image))

    # Faults

    def run(self, faults, seconds):
        """Inject the faults of a plan, then repair everything."""
        start_s = time.monotonic()
        pending = list(reversed(faults))
        while (elapsed_s := time.monotonic() - start_s) < seconds:
            self.feed(elapsed_s)
            if pending and pending[-1].at_s <= elapsed_s:
                self._begin(pending.pop())
            self.supervise()
            time.sleep(0.05)  # noqa: TID251 the plan has real times
        for _, end in self._ends:
            end()
        self._ends.clear()
        for platform in CLOCKS:
            self.chain.step(platform, 0.0)
        self.history.fault("plan", "ended: everything repaired, clocks correct")

    def _begin(self, fault):
        begin, _, name = fault.target.partition(" ")
        if begin == "disk" and name not in self._disks:
            return
        self.history.fault(fault.target, f"{fault.kind} duration_s={fault.duration_s:.1f} offset_s={fault.offset_s:g}")
        self.counts.injected[fault.target, fault.kind] += 1
        now_s = time.monotonic()
        if begin == "clock":
            self.chain.step(name, fault.offset_s)
        elif begin == "link":
            {"cut": self._link.cut, "stall": self._link.stall, "reset": self._link.reset}[fault.kind]()
            if fault.kind != "reset":
                self._ends.append((now_s + fault.duration_s, self._link.mend))
        elif begin == "disk":
            self._disks[name].fill()
            self._ends.append((now_s + fault.duration_s, self._disks[name].empty))
        elif self.chain.status(fault.target) is None:
            send_signal(self.chain, fault.target, signal.Signals[fault.kind])
            if fault.kind == "SIGSTOP":
                pid = self.chain.pid(fault.target)
                self._ends.append((now_s + fault.duration_s, lambda: os.kill(pid, signal.SIGCONT)))
            else:
                self._expected_end.add(fault.target)
                self._down_until_s[fault.target] = now_s + fault.duration_s

    def supervise(self):
        """End the faults whose time is over, and start the processes that have ended."""
        now_s = time.monotonic()
        for due_s, end in list(self._ends):
            if due_s <= now_s:
                self._ends.remove((due_s, end))
                end()
        for name in PROCESSES:
            status = self.chain.status(name)
            if status is None:
                if name in self._expected_end and now_s > self._down_until_s[name] + STUCK_S:
                    pytest.fail(f"{name} has not ended {STUCK_S:.0f} s after SIGTERM: {self.chain.log_tail(name)}")
                continue
            if name not in self._expected_end:
                self.counts.ended_alone[name, status] += 1
                self.history.fault(name, f"ended with status {status}")
                self._expected_end.add(name)
                self._down_until_s[name] = now_s + 1.0
            if now_s >= self._down_until_s[name]:
                self._expected_end.discard(name)
                self.chain.start(name)

    # End

    def wait_until_delivered(self):
        """Wait until every snippet is complete at the shore site and nothing is queued; log what is there."""

        def delivered():
            self.supervise()
            return not self.busy()

        try:
            wait_while_progressing(delivered, self.busy, "delivery", self._describe)
        finally:
            self._log_results()

    def _describe(self):
        tails = "".join(f"\n--- {name}\n{self.chain.log_tail(name)}" for name in PROCESSES)
        return f"{self.busy()}; {self.history.verdict()}{tails}"

    def busy(self):
        """Return the undelivered records as text, an empty text if there are none."""
        if depth := self.source.store.outbox_depth():
            return f"source: {depth} images"
        for service, platform in PLATFORM_OF.items():
            path = self.settings.folder / "state" / platform / f"{service}.db"
            if service != "acoustic_channel" and (depth := queued_records(path)):
                return f"{service}: {depth} records"
        complete = self.complete_snippets()
        return f"{complete} of {self.snippets} snippets are complete" if complete < self.snippets else ""

    def complete_snippets(self):
        """Return the number of complete images of the vehicle's snippets at the shore site."""
        images = [i for i in latest_versions(self.settings.shore_images) if i.name.startswith(f"{UUV}_")]
        return len({i.image_id for i in images if i.complete})

    def _log_results(self):
        self._archive.update()
        for process, folder in (
            ("decompressor", self.settings.vessel_images),
            ("c2 files", self.settings.shore_images),
        ):
            for image in latest_versions(folder):
                if not image.name.startswith(f"{UUV}_"):
                    continue
                number = number_of(tifffile.imread(folder / f"{image.name}.tiff"))
                record = f"unreadable {image.name}" if number is None else f"snippet-{number:04}"
                self.history.add(
                    "handled", process, record, key=SNIPPET_KEY, sha256=image.sha256, detail=f"{image.name}.tiff"
                )


def queued_records(path):
    with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True, timeout=30)) as db:
        return sum(int(db.execute(f"SELECT COUNT(*) FROM {rows}").fetchone()[0]) for rows in UNFINISHED)


@contextmanager
def chaos_chain(folder):
    """Start a chain with v1, 10 % of the frames lost, small disks, and a link between vessel and shore with faults."""
    with ExitStack() as stack:
        ports = (free_port(), free_port(), free_port())
        history = History(folder / "history.jsonl")
        stack.callback(history.close)
        link = LinkEmulator(ports[2], on_fault=lambda fault: history.fault("link", fault))
        stack.callback(link.close)
        settings = ChainSettings(
            folder=folder,
            mode="snippets",
            rate=5,
            loss=0.1,
            time_scale=40.0,
            router_ports=ports,
            shore_port_for_vessel=link.port,
            extra=(("relay", "disk_reserve_bytes = 12_000_000"),),
        )
        places = {name: folder / "state" / name for name in (UUV, VESSEL, SHORE)}
        places["shore images"] = settings.shore_images.parent
        disks = {}
        skipped = ""
        for name, place in places.items():
            try:
                disks[name] = SmallDisk(place, DISK_KB[name])
            except pytest.skip.Exception as reason:
                skipped = f"full disks: {reason}"
                break
            stack.callback(disks[name].close)
        chain = _ClockedChain(settings)
        for platform in CLOCKS:
            chain.step(platform, 0.0)
        stack.enter_context(chain)
        chaos = ChaosChain(chain, link, disks, history)
        stack.callback(chaos.source.stop)
        chaos.counts.skipped += [skipped] * bool(skipped)
        yield chaos


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
