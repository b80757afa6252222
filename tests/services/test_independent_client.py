"""An independent client: `zenoh` (zenoh-cli), which has no code of sonarpost, and plain msgpack.

It receives and decodes what services publish. Services refuse the invalid payloads that it publishes.
"""

import base64
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import msgpack
import numpy as np
import pytest
from builders.common import eventually

from sonarpost.config import PlatformConfig
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.sonar.image_files import write_tiff

ZENOH = Path(sys.executable).with_name("zenoh")
pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(
        not ZENOH.is_file() and shutil.which("zenoh") is None,
        reason="zenoh-cli is not installed (pip install zenoh-cli)",
    ),
]

PlatformMaker = Callable[[str], PlatformConfig]
DETECTED = "sonarpost/v1/uuv-1/contact/detected"
INBOX = "sonarpost/v1/shore/inbox/vessel-1"
ACCEPTED = "sonarpost/v1/shore/contact/vessel-1/decision"
DECISION_KEY = "sonarpost/v1/vessel-1/contact/decision"


def command(router, *arguments):
    program = str(ZENOH) if ZENOH.is_file() else str(shutil.which("zenoh"))
    quiet = ["--cfg", "scouting/multicast/enabled:false", "--cfg", "transport/shared_memory/enabled:false"]
    return [program, "--mode", "client", "--connect", router, *quiet, *arguments]


class Subscriber:
    """`zenoh subscribe` as a process for each key; what it prints, decoded with base64 and msgpack and nothing else.

    One process for several keys may print two values at once on one line.
    """

    def __init__(self, router, *key_expressions):
        self._lines = queue.Queue()
        self._processes = [
            subprocess.Popen(
                command(router, "subscribe", "-k", key, "--decoder", "base64", "--line", "{key} {value}"),
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
            for key in key_expressions
        ]
        for process in self._processes:
            threading.Thread(target=self._read, args=(process,), daemon=True).start()

    def _read(self, process):
        for line in process.stdout:
            self._lines.put(line)

    def next(self):
        key, value = self._lines.get(timeout=120).split()
        return key, msgpack.unpackb(base64.b64decode(value))

    def until(self, key):
        """Return the next record on a key."""
        while (met := self.next())[0] != key:
            pass
        return met[1]

    def close(self):
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.communicate(timeout=120)


@pytest.fixture
def subscribe(router):
    opened = []

    def make(*key_expressions):
        opened.append(Subscriber(router, *key_expressions))
        return opened[-1]

    yield make
    for subscriber in opened:
        subscriber.close()


def put(router, key, payload):
    """Publish bytes, as `zenoh put` does: no attachment, no encoding."""
    value = base64.b64encode(payload).decode()
    done = subprocess.run(
        command(router, "put", "-k", key, "-v", value, "--encoder", "base64"),
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_subscriber_without_sonarpost_reads_what_a_service_publishes(tmp_path, router, platform, subscribe):
    pixels = np.arange(32 * 48, dtype=np.uint16).reshape(32, 48)
    incoming = tmp_path / "incoming"
    incoming.mkdir()
    service = AtdStubService(
        platform("uuv-1"), AtdStubConfig(max_in_flight=0, mode="snippets", input_dir=incoming, poll_s=0.05, settle_s=0)
    )
    service.start()
    try:
        watcher = subscribe(DETECTED, "sonarpost/v1/uuv-1/health/*")
        # Its first health record shows that the subscriber is there, before the one record that comes once only.
        health = watcher.until("sonarpost/v1/uuv-1/health/atd_stub")
        write_tiff(incoming / "rock.tif", pixels)
        snippet = watcher.until(DETECTED)
    finally:
        service.stop()
    assert (health["type"], health["v"], health["state"], health["service"]) == ("health", 1, "ok", "atd_stub")
    assert (snippet["type"], snippet["v"], snippet["source"]) == ("snippet", 1, "rock.tif")
    assert snippet["contact"]["vehicle_id"] == "uuv-1"
    assert snippet["contact"]["lat_deg"] is None
    picture = snippet["picture"]
    assert (picture["height_px"], picture["width_px"], picture["bits"]) == (32, 48, 16)
    assert np.frombuffer(picture["data"], "<u2").reshape(32, 48).tolist() == pixels.tolist()


def decision(number):
    """Return a decision packed by hand, from the document alone."""
    return bytes(
        msgpack.packb(
            {
                "type": "decision",
                "v": 1,
                "decision_id": f"d{number}",
                "vessel_id": "vessel-1",
                "vehicle_id": "uuv-1",
                "image_id": "0001",
                "image_version": 1,
                "verdict": "unsure",
                "operator": "operator-7",
                "decided_utc_s": 1476262900,
            }
        )
    )


def envelope(payload, key=DECISION_KEY):
    fields = {"type": "relayed", "v": 1, "vessel_id": "vessel-1", "key": key, "payload": payload, "relayed_utc_s": 0}
    return bytes(msgpack.packb(fields))


INVALID = {
    "no msgpack": (b"\xc1 text", "payload"),
    "text": (b"hello", "payload"),
    "another record": (decision(9), "type"),
    "a later version": (msgpack.packb(msgpack.unpackb(envelope(decision(9))) | {"v": 2}), "v"),
    "a field missing": (msgpack.packb({"type": "relayed", "v": 1, "vessel_id": "vessel-1"}), "key"),
    "no record in an envelope": (envelope(b"\xc1"), "payload"),
    "an unknown key in an envelope": (envelope(decision(9), "sonarpost/v1/vessel-1/etc/passwd"), "key"),
    "one vessel in the name of another": (envelope(decision(9), "sonarpost/v1/vessel-2/contact/decision"), "key"),
}


def test_invalid_payloads_are_refused_and_logged_and_the_service_continues(
    tmp_path, router, platform, subscribe, caplog
):
    service = C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out"))
    service.start()
    try:
        watcher = subscribe(ACCEPTED, "sonarpost/v1/shore-1/health/c2")
        watcher.until("sonarpost/v1/shore-1/health/c2")
        put(router, INBOX, envelope(decision(1)))
        assert watcher.until(ACCEPTED)["decision_id"] == "d1"
        for number, (payload, _) in enumerate(INVALID.values(), start=1):
            put(router, INBOX, payload)
            eventually(lambda number=number: service.store.refused_count() == number)
        # Valid records are still accepted.
        put(router, INBOX, envelope(decision(2)))
        assert watcher.until(ACCEPTED)["decision_id"] == "d2"
        health = watcher.until("sonarpost/v1/shore-1/health/c2")
        assert health["state"] == "ok"
        assert health["counters"]["records_refused"] == len(INVALID)
        assert health["gauges"]["refused"] == len(INVALID)
        reasons = [str(row[0]) for row in service.store._query("SELECT reason FROM refused ORDER BY id")]
    finally:
        service.stop()
    kept = sorted(path.name for path in (tmp_path / "out").rglob("*.json"))
    assert kept == ["6431.json", "6432.json"]
    fields = [field for _, field in INVALID.values()]
    assert [reason.split(": ")[1] for reason in reasons] == fields
    assert all("expected" in reason for reason in reasons)
    # The log has the first refusal of a peer in each minute, and the number of the others.
    complaints = [vars(record)["fields"] for record in caplog.records if record.message == "Record refused"]
    assert complaints[0]["field"] == fields[0]
    assert len(complaints) + sum(complaint.get("suppressed", 0) for complaint in complaints) == len(fields)
