"""Random faults in a running chain: in every process, the radio link, the clocks and the disks.

A plan of faults follows from a seed alone. `ChaosChain` runs all services and routers of vehicle, vessel and shore
site, injects the faults of a plan, starts every process that ended, as a supervisor does, and writes the operation log.

Two sources run all the time. Snippets enter the folder of the vehicle and travel over the acoustic link; each shows its
own number as a pattern of blocks, so that it is identified by its pixels at the end. Images of a second vehicle enter
the relay from a durable outbox.
"""

import os
import random
import signal
import sqlite3
import sys
import time
from collections import Counter
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field

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
