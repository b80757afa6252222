"""Codecs for a system user: no home folder, and an installation that the user cannot write."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from builders.common import REPOSITORY, eventually
from builders.images import snippet as snippet_pixels
from builders.record_samples import SAMPLES

from sonarpost import keys
from sonarpost.messages import EncodedImage, ReceivedImage, ReconstructedImage
from sonarpost.sonar.image_files import write_png

NOBODY = 65534
# The interpreter may be in the home folder of root. The capability permits reading files, not writing them.
AS_NOBODY = (
    *("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"),
    *("--inh-caps=-all,+dac_read_search", "--ambient-caps=-all,+dac_read_search"),
)
IN_MEMORY = "Preparing machine code for the vq codec: about 2 s, in each process: no folder for it is writable"
PYTHON_API = """
import numpy, sonarpost
image = numpy.random.default_rng(1).integers(0, 256, (40, 60), dtype=numpy.uint8)
assert sonarpost.decode(sonarpost.encode(image, "vq")).shape == image.shape
print("decoded")
"""


class Installation:
    """A copy of the package without machine code, which the user of `command` cannot write."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._prefix = AS_NOBODY if os.getuid() == 0 else ()
        copied = shutil.ignore_patterns("__pycache__")
        shutil.copytree(REPOSITORY / "common" / "sonarpost", folder / "sonarpost", ignore=copied)
        self.protect()

    def protect(self) -> None:
        for path in [self._folder, *self._folder.rglob("*")]:
            path.chmod(0o555 if path.is_dir() else 0o444)

    def environment(self, **extra: str) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        return {**kept, "HOME": "/nonexistent", "PYTHONPATH": str(self._folder), "OMP_NUM_THREADS": "1", **extra}

    def command(self, *arguments: str) -> list[str]:
        return [*self._prefix, sys.executable, *arguments]

    def run(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        environment = self.environment()
        command = self.command(*arguments)
        return subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=170)

    def machine_code(self) -> list[Path]:
        return list(self._folder.rglob("*.nbc"))


@pytest.fixture
def installation() -> Iterator[Installation]:
    if os.getuid() == 0:
        probe = [*AS_NOBODY, sys.executable, "-c", "import os; os.mkdir('/nonexistent')"]
        if (
            shutil.which("setpriv") is None
            or b"PermissionError" not in subprocess.run(probe, check=False, capture_output=True).stderr
        ):
            pytest.skip("cannot run the interpreter as user nobody: setpriv is missing or has no capability to pass on")
    with tempfile.TemporaryDirectory() as name:
        installed = Installation(Path(name))
        yield installed
        for folder in [Path(name), *Path(name).rglob("*")]:
            if folder.is_dir():
                folder.chmod(0o755)


@pytest.fixture
def image_file(tmp_path: Path) -> Path:
    path = tmp_path / "snippet.png"
    write_png(path, snippet_pixels(40, 60))
    return path


def test_the_python_api_compiles_in_memory_and_warns_once(installation: Installation) -> None:
    done = installation.run("-c", PYTHON_API)
    assert done.stdout == "decoded\n", done.stderr
    [warning] = done.stderr.splitlines()
    assert warning.startswith(IN_MEMORY)
    assert "set NUMBA_CACHE_DIR" in warning


def test_encode_compiles_in_memory_and_warns_once(installation, image_file, tmp_path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    out.chmod(0o777)
    done = installation.run("-m", "sonarpost.cli.main", "encode", "--codec", "vq", "--out", str(out), str(image_file))
    assert done.returncode == 0, done.stderr
    assert len(list(out.iterdir())) == 1
    [warning] = done.stderr.splitlines()
    assert warning.startswith(IN_MEMORY)


def test_code_prepared_by_the_installing_user_is_loaded(installation, image_file) -> None:
    encode = "import sys, numpy, sonarpost; from sonarpost.codec.jit import compilation_log as log; "
    encode += "sonarpost.encode(numpy.zeros((40, 60), 'uint8'), 'vq'); print(log.compiled)"
    for folder in installation._folder.rglob("*"):
        if folder.is_dir():
            folder.chmod(0o755)
    as_installer = [sys.executable, "-c", encode]
    subprocess.run(as_installer, check=True, env=installation.environment(), capture_output=True)
    assert installation.machine_code()
    installation.protect()
    done = installation.run("-c", encode)
    assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.fixture
def run_service(installation, router, tmp_path) -> Iterator[Callable[[str, str], Path]]:
    """Start a service with the shipped configuration of its platform; return its state folder."""
    started: list[subprocess.Popen[bytes]] = []
    state = tmp_path / "services"
    state.mkdir()
    if os.getuid() == 0:
        os.chown(state, NOBODY, NOBODY)

    def start(platform: str, service: str) -> Path:
        changes = {
            "SONARPOST_PLATFORM__ROUTER": json.dumps([router]),
            "SONARPOST_PLATFORM__STATE_DIR": str(state),
            "SONARPOST_DECOMPRESSOR__OUT_DIR": str(state / "pictures"),
        }
        config = REPOSITORY / "config" / f"{platform}.toml"
        with (tmp_path / f"{service}.log").open("wb") as log:
            arguments = ("-m", "sonarpost.cli.main", "run", service, "--config", str(config))
            environment = installation.environment(**changes)
            started.append(subprocess.Popen(installation.command(*arguments), env=environment, stderr=log))
        return state

    yield start
    for process in started:
        process.terminate()
    assert [process.wait(20) for process in started] == [0] * len(started)


@pytest.mark.timeout(600)  # compiles encoder and decoder of emb: 20 s on an idle machine
def test_the_shipped_services_encode_and_decode_and_store_machine_code_in_the_state_folder(
    installation, run_service, runner, snippet, tmp_path
) -> None:
    modem = runner.peer("uuv-1", "uuv_modem", {keys.image_encoded("uuv-1"): EncodedImage})
    state = run_service("uuv", "compressor")
    runner.peer("uuv-1", "atd_stub").send(keys.contact_detected("uuv-1"), "compressor", snippet("c1"))
    eventually(lambda: modem.received, 300, what=f"an image; see {tmp_path / 'compressor.log'}")
    relay = runner.peer("vessel-1", "relay", {keys.image_reconstructed("vessel-1"): ReconstructedImage})
    run_service("vessel", "decompressor")
    coded = modem.received[0]
    length = len(coded.stream)
    changes = {
        "contact": coded.contact,
        "height_px": coded.height_px,
        "width_px": coded.width_px,
        "stream": coded.stream,
        "bytes_received": length,
        "bytes_total": length,
    }
    received = SAMPLES["received-image-v1-authenticated"].model_copy(update=changes)
    assert isinstance(received, ReceivedImage)
    runner.peer("vessel-1", "op_modem").send(keys.acoustic_image("vessel-1"), "decompressor", received)
    eventually(lambda: relay.received, 200, what=f"an image; see {tmp_path / 'decompressor.log'}")
    stored = list((state / "machine-code").rglob("*.nbc"))
    assert stored
    assert {path.stat().st_uid for path in stored} == {NOBODY if os.getuid() == 0 else os.getuid()}
    assert not installation.machine_code()
