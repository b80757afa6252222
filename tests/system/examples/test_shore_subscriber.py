"""The example program as a separate process, with c2."""

import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from builders.common import REPOSITORY, eventually, running
from builders.exports import decision, image
from builders.shore import relayed
from PIL import Image

from sonarpost import keys, wire
from sonarpost.messages import Pixels
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

EXAMPLE = REPOSITORY / "examples" / "shore_subscriber.py"


@pytest.fixture
def c2(router, platform, tmp_path):
    with running(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out"))) as service:
        yield service


def test_example_is_short_and_needs_only_zenoh_and_msgpack():
    text = EXAMPLE.read_text()
    assert len(text.splitlines()) <= 25
    modules = set(re.findall(r"^(?:import|from) (\w+)", text, re.MULTILINE))
    assert modules - set(sys.stdlib_module_names) == {"zenoh", "msgpack"}


def test_example_prints_records_and_saves_images(router, c2, tmp_path):
    saved = tmp_path / "saved"
    saved.mkdir()
    wide = np.array([[0, 255, 256], [40_000, 65_535, 1]], np.uint16)
    grey = np.arange(6, dtype=np.uint8).reshape(2, 3)
    publisher = c2.session.declare_publisher(keys.shore_image("vessel-1"))
    command = [sys.executable, "-I", str(EXAMPLE), router, str(saved)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        eventually(lambda: publisher.matching_status.matching, what="subscription of the example")
        second = image("0002", pixels=Pixels.from_array(grey), version=2).model_copy(update={"contact": None})
        for record in (image("0001", pixels=Pixels.from_array(wide)), second, decision("0001", verdict="mine_like")):
            c2.session.put(keys.shore_inbox("vessel-1"), wire.encode(relayed(record)))
        lines = [process.stdout.readline() for _ in range(3)]
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)
    assert lines[0].startswith("reconstructed_image uuv-1 0001 None {'contact_id': 'uuv-1/0001'")
    assert "'lat_deg': 41.52513339" in lines[0]
    assert lines[1:] == ["reconstructed_image uuv-1 0002 None None\n", "decision uuv-1 0001 mine_like None\n"]
    found = {path.name: np.asarray(Image.open(path)) for path in saved.iterdir()}
    assert sorted(found) == ["uuv-1_1476262801_0001_v1.pgm", "uuv-1_1476262801_0002_v2.pgm"]
    np.testing.assert_array_equal(found["uuv-1_1476262801_0001_v1.pgm"], wide)
    np.testing.assert_array_equal(found["uuv-1_1476262801_0002_v2.pgm"], grey)
