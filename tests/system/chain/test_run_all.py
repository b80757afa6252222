"""A vehicle, a vessel and a shore site with `sonarpost run all` and the shipped configurations.

The user has no home folder and cannot write the installation, as a system user of a host.
"""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from builders.chain import snippet
from builders.common import LONG_WAIT_S, eventually, free_port
from builders.installation import installation

from sonarpost.extensions.simulation.demo.outcome import read_images
from sonarpost.security.acoustic_key import create_key
from sonarpost.sonar.image_files import write_png

__all__ = ["installation"]

pytestmark = pytest.mark.chain

IMAGES = 3
TIME_SCALE = 20
PLATFORMS = ("uuv", "vessel", "shore")


class Bench:
    """Three platforms on one host, each with the shipped configuration in a folder instead of /var/lib/sonarpost."""

    def __init__(self, folder, installed):
        self.folder = folder
        self._installed = installed
        self.processes = {}
        for name in PLATFORMS:
            home = folder / name
            home.mkdir()
            done = installed.run("-m", "sonarpost.cli.main", "config", "example", name)
            (home / "platform.toml").write_text(done.stdout.replace("/var/lib/sonarpost", str(home)))
        create_key(folder / "uuv" / "acoustic.key")
        for name in ("uuv", "vessel"):
            (folder / name / "acoustic").mkdir()
            key = folder / name / "acoustic" / "acoustic.key"
            key.write_bytes((folder / "uuv" / "acoustic.key").read_bytes())
            key.chmod(0o600)
        (folder / "uuv" / "incoming").mkdir()

    def start(self, name, *arguments, **environment):
        """Start a sonarpost command as the user without a home; its output goes to NAME.log."""
        with (self.folder / f"{name}.log").open("wb") as log:
            process = subprocess.Popen(
                self._installed.command("-m", "sonarpost.cli.main", *arguments),
                env=self._installed.environment(**environment),
                stdout=log,
                stderr=subprocess.STDOUT,
                process_group=0,
            )
        self.processes[name] = process
        return process

    def log(self, name):
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def run_all(self, name, **environment):
        config = str(self.folder / name / "platform.toml")
        self.start(name, "run", "all", "--config", config, SONARPOST_CONSOLE__PORT="0", **environment)

    def children(self, name):
        pid = self.processes[name].pid
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.fixture
def bench(tmp_path, installation):
    tmp_path.chmod(0o755)
    folder = tmp_path / "bench"
    folder.mkdir()
    started = Bench(folder, installation)
    yield started
    for process in reversed(started.processes.values()):  # the emulated modems last
        process.kill()
        process.wait()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_contacts_reach_the_shore_site_from_the_shipped_configurations(bench):
    emulator = bench.start("modems", "modem-emulator", "--modems", "2", "--tcp", "--time-scale", str(TIME_SCALE))
    eventually(lambda: bench.log("modems").count("\n") >= 1, what="the emulated modems")
    first, second = (modem["device"] for modem in json.loads(bench.log("modems").splitlines()[0])["modems"])
    ports = [free_port() for _ in range(3)]
    uuv, vessel, shore = (f'["tcp/127.0.0.1:{port}"]' for port in ports)

    bench.run_all("shore", SONARPOST_PLATFORM__ROUTER=shore)
    bench.run_all(
        "vessel", SONARPOST_PLATFORM__ROUTER=vessel, SONARPOST_PLATFORM__UPSTREAM=shore, SONARPOST_OP_MODEM__PORT=second
    )
    bench.run_all(
        "uuv", SONARPOST_PLATFORM__ROUTER=uuv, SONARPOST_UUV_MODEM__PORT=first, SONARPOST_ATD_STUB__MODE="snippets"
    )
    for number in range(IMAGES):
        hidden = bench.folder / "uuv" / "incoming" / f".{number}.png"
        write_png(hidden, snippet(number))
        hidden.rename(hidden.with_name(hidden.name[1:]))

    images = bench.folder / "shore" / "images" / "vessel-1"

    def complete():
        return len({image.image_id for image in read_images(images).values() if image.complete})

    eventually(lambda: complete() == IMAGES, LONG_WAIT_S, f"complete images at the shore site; see {bench.folder}")
    assert "Traceback" not in bench.log("uuv") + bench.log("vessel") + bench.log("shore")
    assert list((bench.folder / "uuv" / "state" / "machine-code").rglob("*.nbc"))

    def have_logged(name, services):
        return {line.partition(" | ")[0].strip() for line in bench.log(name).splitlines()} >= services

    # An image at the shore site needs no console.
    eventually(lambda: have_logged("uuv", {"router", "atd_stub", "compressor", "uuv_modem"}), what="logs")
    eventually(lambda: have_logged("vessel", {"router", "op_modem", "decompressor", "relay", "console"}), what="logs")
    eventually(lambda: have_logged("shore", {"router", "c2", "console"}), what="logs")

    children = [pid for name in PLATFORMS for pid in bench.children(name)]
    assert len(children) == 4 + 5 + 3
    for name in PLATFORMS:
        bench.processes[name].send_signal(signal.SIGINT)
    for name in PLATFORMS:
        assert bench.processes[name].wait(120) == 0, bench.log(name)[-2000:]
        # The services stop before the router.
        assert bench.log(name).rstrip().splitlines()[-1].endswith("Router stopped")
    assert not [pid for pid in children if Path(f"/proc/{pid}").exists()]
    assert emulator.poll() is None
