"""Codecs for a system user: no home folder, and an installation that the user cannot write."""

import json
import subprocess
import sys

import pytest
from builders.common import LONG_WAIT_S, REPOSITORY, eventually
from builders.images import snippet as snippet_pixels
from builders.installation import installation
from builders.record_samples import SAMPLES

from sonarpost import keys
from sonarpost.messages import CodedImage, EncodedImage, ReceivedImage
from sonarpost.sonar.image_files import write_png

__all__ = ["installation"]

pytestmark = pytest.mark.system

IN_MEMORY = "Preparing machine code for the emb codec: about 10 s, in each process: no folder for it is writable"
PYTHON_API = """
import numpy, sonarpost
image = numpy.random.default_rng(1).integers(0, 256, (40, 60), dtype=numpy.uint8)
assert sonarpost.decode(sonarpost.encode(image, budget=64)).shape == image.shape
print("decoded")
"""


@pytest.fixture
def image_file(tmp_path):
    path = tmp_path / "snippet.png"
    write_png(path, snippet_pixels(40, 60))
    return path


def test_the_python_api_compiles_in_memory_and_warns_once(installation):
    done = installation.run("-c", PYTHON_API)
    assert done.stdout == "decoded\n", done.stderr
    [warning] = done.stderr.splitlines()
    assert warning.startswith(IN_MEMORY)
    assert "set NUMBA_CACHE_DIR" in warning


def test_encode_compiles_in_memory_and_warns_once(installation, image_file, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    out.chmod(0o777)
    done = installation.run("-m", "sonarpost.cli.main", "encode", "--out", str(out), str(image_file))
    assert done.returncode == 0, done.stderr
    assert len(list(out.iterdir())) == 1
    [warning] = done.stderr.splitlines()
    assert warning.startswith(IN_MEMORY)


def test_code_prepared_by_the_installing_user_is_loaded(installation, image_file):
    encode = "import sys, numpy, sonarpost; from sonarpost.codec.jit import compilation_log as log; "
    encode += "sonarpost.encode(numpy.zeros((40, 60), 'uint8'), budget=64); print(log.compiled)"
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
def run_service(installation, router, tmp_path):
    """Start a service with the shipped configuration of its platform; return its state folder."""
    started = []
    state = tmp_path / "services"
    state.mkdir()

    def start(platform, service):
        changes = {
            "SONARPOST_PLATFORM__ROUTER": json.dumps([router]),
            "SONARPOST_PLATFORM__STATE_DIR": str(state),
            "SONARPOST_DECOMPRESSOR__OUT_DIR": str(state / "images"),
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
    assert [process.wait(120) for process in started] == [0] * len(started)


def test_the_shipped_services_encode_and_decode_and_store_machine_code_in_the_state_folder(
    installation, run_service, runner, snippet, tmp_path
):
    modem = runner.peer("uuv-1", "uuv_modem", {keys.image_encoded("uuv-1"): EncodedImage})
    state = run_service("uuv", "compressor")
    runner.peer("uuv-1", "atd_stub").send(keys.contact_detected("uuv-1"), "compressor", snippet("c1"))
    eventually(lambda: modem.received, LONG_WAIT_S, what=f"an image; see {tmp_path / 'compressor.log'}")
    relay = runner.peer("vessel-1", "relay", {keys.image_coded("vessel-1"): CodedImage})
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
    received = SAMPLES["received-image-classified"].model_copy(update=changes)
    assert isinstance(received, ReceivedImage)
    runner.peer("vessel-1", "op_modem").send(keys.acoustic_image("vessel-1"), "decompressor", received)
    eventually(lambda: relay.received, LONG_WAIT_S, what=f"an image; see {tmp_path / 'decompressor.log'}")
    stored = list((state / "machine-code").rglob("*.nbc"))
    assert stored
    assert not installation.machine_code()
