"""A chain of real processes for tests: snippets instead of surveys, a fast channel."""

import dataclasses
import os
import signal
import time
from contextlib import ExitStack

import numpy as np
import pytest

from builders.common import eventually, free_port
from builders.history import History
from builders.progress import wait_while_progressing
from sonarpost import keys
from sonarpost.extensions.simulation.demo.chain import Chain
from sonarpost.extensions.simulation.demo.outcome import evaluate, last_versions, read_images
from sonarpost.extensions.simulation.demo.settings import VESSEL, ChainSettings
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.link.frames.paper.frame import parse_frame
from sonarpost.messages import AcousticFrame, ReceivedImage
from sonarpost.sonar.image_files import write_png

IMAGES = 6
TIME_SCALE = 40.0


def snippet(number):
    """Return a snippet of seabed with a highlight and a shadow, shape (80, 140)."""
    rng = np.random.default_rng(number)
    image = rng.gamma(4.0, 25.0, (80, 140))
    image[30:44, 50:60] += 120
    image[32:42, 60:100] *= 0.1
    return np.clip(image, 0, 255).astype(np.uint8)


def latest_versions(folder):
    """Return the last version of each image of a folder, an image that has two sets of files twice."""
    return last_versions(read_images(folder))


def send_signal(chain, name, number):
    """Send a signal to a process of a chain.

    Emulated modems that are killed leave links to their terminals. The emulator of another test can get terminals of
    these names, and the vehicle of this one would transmit into its channel: the links are removed first.
    """
    if (name, number) == ("acoustic_channel", signal.SIGKILL):
        for link in chain.settings.ports_folder.glob("*"):
            link.unlink()
    os.kill(chain.pid(name), number)


class VesselWatcher(Watcher):
    """Collects also what op_modem received, in the paper's format.

    Attributes:
        images_with_frames: Images of which a frame was published. A frame is published once, after op_modem has
            committed it: a kill between the two leaves the frame out here.
        images_received: Images of which a received_image was published. The outbox publishes each record that it has
            not delivered, again after a restart.
    """

    def __init__(self, settings, check):
        super().__init__(settings, check)
        self.images_with_frames = set()
        self.images_received = set()

    def __enter__(self):
        super().__enter__()
        vessel = self._open(self.settings.router_ports[1])
        self._subscribe(vessel, keys.acoustic_rx(VESSEL), AcousticFrame, self._on_frame)
        self._subscribe(vessel, keys.acoustic_image(VESSEL), ReceivedImage, self._on_received_image)
        return self

    def _on_frame(self, frame):
        if self.settings.link == "paper":
            self.images_with_frames.add(parse_frame(frame.data).image_id)

    def _on_received_image(self, image):
        self.images_received.add(image.image_id)


class RunningChain:
    def __init__(self, chain, watcher):
        self.chain = chain
        self.watcher = watcher
        self.settings = chain.settings
        self.deposited = 0
        self.history = History(chain.settings.folder / "history.jsonl")

    def deposit(self, count=IMAGES):
        """Put snippets into the folder that the vehicle polls."""
        for _ in range(count):
            hidden = self.settings.incoming / f".snippet-{self.deposited:03}.png"
            write_png(hidden, snippet(self.deposited))
            hidden.rename(hidden.with_name(hidden.name[1:]))
            self.deposited += 1

    def kill(self, name):
        self.history.fault(name, "SIGKILL")
        send_signal(self.chain, name, signal.SIGKILL)
        eventually(lambda: self.chain.status(name) is not None, what=f"end of {name}")

    def assert_delivered_once(self):
        """Check that each encoded image is at the vessel and at the shore site, once and unchanged.

        All versions of an image are one record; its digest is that of its last version's file.
        """
        for image_id in self.watcher.encoded:
            self.history.add("queued", "compressor", image_id)
        for process, folder in (("decompressor", self.settings.vessel_images), ("c2", self.settings.shore_images)):
            self.history.add("consumer", process)
            for image in latest_versions(folder):
                self.history.add("handled", process, image.image_id, sha256=image.sha256, detail=image.name)
        verdict = self.history.verdict()
        assert verdict.ok, f"{self.history.path}: {verdict}"

    def outcome(self):
        return evaluate(self.settings, self.watcher.snippets, self.watcher.contact_of_image, 0.0)

    def until(self, condition, what):
        """Wait for `condition()`; fail with what keeps the chain busy when no record and no counter changes."""
        wait_while_progressing(condition, self._progress, what, lambda: f"busy: {self.busy()}")

    def _progress(self):
        watcher = self.watcher
        counters = [sum(report.counters.values()) for report in list(watcher.health.values())]
        return watcher.changes, len(watcher.images_received), counters

    def terminate(self, name):
        """End a process (SIGTERM); return its exit status."""
        os.kill(self.chain.pid(name), signal.SIGTERM)
        self.until(lambda: self.chain.status(name) is not None, f"end of {name}")
        return self.chain.status(name)

    def busy(self):
        """Return what keeps the chain busy, an empty text if nothing does."""
        return self.watcher.busy(0, time.time() - 30.0)

    def until_idle(self):
        """Wait until the chain has been idle for longer than a packet, by reports made after it became idle."""
        idle_since_utc_s = 0.0

        def quiet():
            nonlocal idle_since_utc_s
            if self.busy():
                idle_since_utc_s = 0.0
                return False
            idle_since_utc_s = idle_since_utc_s or time.time()
            return time.time() - idle_since_utc_s > 1.5 and not self.watcher.busy(0, idle_since_utc_s)

        self.until(quiet, "chain idle")


@pytest.fixture
def start_chain(tmp_path):
    """Starts a chain of the paper's format; it is stopped at the end of the test."""
    with ExitStack() as stack:

        def start(**changes):
            settings = ChainSettings(
                folder=tmp_path / "run",
                mode="snippets",
                link="paper",
                time_scale=TIME_SCALE,
                router_ports=(free_port(), free_port(), free_port()),
            )
            settings = dataclasses.replace(settings, **changes)
            chain = stack.enter_context(Chain(settings))
            watcher = stack.enter_context(VesselWatcher(settings, chain.check))
            watcher.wait_until_started()
            run = RunningChain(chain, watcher)
            stack.callback(run.history.close)
            return run

        yield start
