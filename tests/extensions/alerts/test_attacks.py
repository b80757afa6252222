"""Alerts about one vessel that are refused, or answered without an end, delay no other vessel."""

import json
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from builders.common import eventually
from builders.exports import image
from builders.shore import Site

VESSEL, HOSTILE = "vessel-1", "vessel-2"


class Receiver(BaseHTTPRequestHandler):
    """Accepts the alerts of vessel-1; to those of the hostile vessel it replies without an end, then 403 or 500."""

    def do_POST(self):
        alert = json.loads(self.rfile.read(int(self.headers["Content-Length"])))["contact"]
        if alert["vessel_id"] == VESSEL:
            self.server.accepted.add(alert["image_id"])
            self.send_response(200)
            self.end_headers()
            return
        self.server.replies += 1
        if self.server.replies > 1:
            self.send_response(403 if self.server.replies % 2 else 500)
            self.end_headers()
            return
        with suppress(OSError):
            while True:
                self.wfile.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    def log_message(self, *_):
        pass


@pytest.fixture
def receiver():
    server = ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
    server.daemon_threads = True
    server.accepted, server.replies = set(), 0
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.mark.system
def test_refused_alerts_delay_no_other_vessel(router, client, receiver, tmp_path):
    arguments = ["c2", "alert", "--webhook", f"http://127.0.0.1:{receiver.server_address[1]}/"]
    arguments += ["--state", str(tmp_path / "alerts.db"), "--router", router, "--stored"]
    site = Site(client, *(image(f"{number:04d}", vessel_id=HOSTILE) for number in range(100)))
    process = subprocess.Popen([sys.executable, "-m", "sonarpost.cli.main", *arguments])
    try:
        eventually(lambda: receiver.replies > 1, what="an alert after the reply without an end")
        names = {f"{number:04d}" for number in range(3)}
        site.accept(*(image(f"{number:04d}", vessel_id=HOSTILE) for number in range(100, 200)))
        site.accept(*(image(name, vessel_id=VESSEL) for name in names))
        eventually(lambda: receiver.accepted == names, what="alerts of the other vessel")
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
    finally:
        process.kill()
        process.wait()
