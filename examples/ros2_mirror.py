"""Mirrors the contacts of a shore site as std_msgs/String with JSON: ros2_mirror.py tcp/127.0.0.1:7447 [ROS_ROUTER].

zenoh-bridge-ros2dds passes what is published on the key `sonarpost/contacts` to the ROS 2 topic /sonarpost/contacts.
"""

import json
import signal
import struct
import sys

import msgpack
import zenoh

KEY = "sonarpost/contacts"


def cdr_string(text: str) -> bytes:
    """Return std_msgs/String as CDR: header (little endian), length with the final zero byte, UTF-8."""
    data = text.encode() + b"\0"
    return struct.pack("<BBBBI", 0, 1, 0, 0, len(data)) + data


def json_text(payload: bytes) -> str:
    """Return a record as JSON, without its pixels."""
    record = msgpack.unpackb(payload)
    return json.dumps({name: value for name, value in record.items() if name not in ("pixels", "missing_mask")})


def connect(endpoint: str) -> zenoh.Session:
    """Open a session; wait for the router without a time limit."""
    settings = {"mode": "client", "connect": {"endpoints": [endpoint], "timeout_ms": -1}}
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program, also while it waits for the router
    print(f"waiting for {' and '.join(sys.argv[1:3])}", file=sys.stderr)
    site, ros = connect(sys.argv[1]), connect(sys.argv[-1])
    with site, ros, site.declare_subscriber("sonarpost/v1/shore/contact/**") as records:
        print("subscribed", file=sys.stderr)
        for sample in records:
            if str(sample.key_expr).rpartition("/")[2] in ("image", "decision"):
                ros.put(KEY, cdr_string(json_text(sample.payload.to_bytes())))
