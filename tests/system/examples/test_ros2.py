"""Examples for ROS 2: the mirror with a router, the node as far as its syntax (ROS is not installed here)."""

import json
import py_compile
import struct
import subprocess
import sys

from builders.common import REPOSITORY, eventually, publish_once
from builders.exports import decision, image

from sonarpost import keys, wire

EXAMPLES = REPOSITORY / "examples"


def text_of(data):
    """Decode std_msgs/String as CDR of XCDR1, little endian."""
    header, length = struct.unpack_from("<4sI", data)
    assert (header, length) == (b"\0\1\0\0", len(data) - 8)
    assert data.endswith(b"\0")
    return data[8:-1].decode()


def test_mirror_publishes_records_as_ros_strings(router, client):
    received = []
    client.declare_subscriber("sonarpost/contacts", lambda sample: received.append(sample.payload.to_bytes()))
    process = subprocess.Popen([sys.executable, EXAMPLES / "ros2_mirror.py", router], stderr=subprocess.DEVNULL)
    try:
        publish_once(client, keys.shore_image("vessel-1"), wire.encode(image()))
        publish_once(client, keys.shore_decision("vessel-1"), wire.encode(decision(remark="ü")))
        eventually(lambda: len(received) == 2)
    finally:
        process.kill()
        process.wait()
    first, second = (json.loads(text_of(data)) for data in received)
    assert (first["type"], first["contact"]["lat_deg"]) == ("reconstructed_image", 41.52513339)
    assert "pixels" not in first
    assert (second["type"], second["remark"]) == ("decision", "ü")


def test_node_compiles(tmp_path):
    py_compile.compile(str(EXAMPLES / "ros2_contacts.py"), cfile=str(tmp_path / "node.pyc"), doraise=True)
