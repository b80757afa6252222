"""`sonarpost c2 cot` with a TAK server, taky: its clients receive the contacts and download their images."""

import hashlib
import http.client
import io
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
import zipfile
from contextlib import ExitStack, closing
from pathlib import Path
from urllib.parse import urlsplit
from xml.etree import ElementTree as ET

import pytest
from builders.common import eventually
from builders.exports import image
from builders.shore import Site

TAKY = shutil.which("taky", path=os.environ.get("SONARPOST_TAKY"))
COT_PORT, FILES_PORT = 8089, 8443
"""The ports of taky; that of its files cannot be changed."""

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(TAKY is None, reason="no taky: pip install taky, or set SONARPOST_TAKY to its folder"),
]


def is_open(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def certificates(tmp_path):
    """Run a TAK server; the fixture is its authority, and certificate and key of a client."""
    if is_open(COT_PORT) or is_open(FILES_PORT):
        pytest.skip(f"port {COT_PORT} or {FILES_PORT} is in use")
    assert TAKY is not None
    programs, folder = Path(TAKY).parent, tmp_path / "taky"

    def takyctl(where, *arguments):
        subprocess.run([programs / "takyctl", *arguments], cwd=where, check=True, capture_output=True)

    takyctl(tmp_path, "setup", "--host", "localhost", "--bind-ip", "127.0.0.1", "--public-ip", "127.0.0.1", "taky")
    takyctl(folder, "-c", "taky.conf", "build_client", "sonarpost", "--dump_pem")
    [certificate], [key] = folder.glob("sonarpost-*.crt"), folder.glob("sonarpost-*.key")
    with ExitStack() as stack, (tmp_path / "taky.log").open("wb") as log:
        for name in ("taky", "taky_dps"):
            process = stack.enter_context(
                subprocess.Popen([programs / name, "-c", "taky.conf"], cwd=folder, stdout=log, stderr=log)
            )
            stack.callback(process.terminate)
        eventually(lambda: is_open(COT_PORT) and is_open(FILES_PORT), what="the TAK server")
        yield folder / "ssl" / "ca.crt", certificate, key


class TakClient:
    """A client of the server that collects events in a thread."""

    def __init__(self, context):
        connection = socket.create_connection(("127.0.0.1", COT_PORT))
        self._socket = context.wrap_socket(connection, server_hostname="localhost")
        self._received = b""
        self._socket.sendall(
            b'<event version="2.0" uid="watcher" type="a-f-G-U-C" how="m-g" time="2026-01-01T00:00:00Z"'
            b' start="2026-01-01T00:00:00Z" stale="2036-01-01T00:00:00Z"><point lat="0" lon="0" hae="0" ce="9" le="9"/>'
            b'<detail><contact callsign="watcher"/></detail></event>'
        )
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self):
        while data := self._socket.recv(1 << 16):
            self._received += data

    def events(self, kind):
        whole, separator, _ = self._received.rpartition(b"</event>")
        found = ET.fromstring(b"<events>" + whole + separator + b"</events>")
        return [event for event in found if event.attrib["type"] == kind]

    def close(self):
        self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()


def context_of(certificates):
    authority, certificate, key = certificates
    context = ssl.create_default_context(cafile=authority)
    context.load_cert_chain(certificate, key)
    return context


def download(url, certificates):
    parts = urlsplit(url)
    with closing(http.client.HTTPSConnection("localhost", parts.port, context=context_of(certificates))) as connection:
        connection.request("GET", f"{parts.path}?{parts.query}")
        reply = connection.getresponse()
        assert reply.status == 200
        return reply.read()


def test_clients_of_a_tak_server_receive_contacts_and_images(router, client, certificates):
    Site(client, image("0001"), image("0002"))
    watcher = TakClient(context_of(certificates))
    authority, certificate, key = map(str, certificates)
    server = [f"tls://localhost:{COT_PORT}", "--cot-ca", authority, "--cot-certificate", certificate, "--cot-key", key]
    files = ["--tak-api", f"https://localhost:{FILES_PORT}", "--stored"]
    command = [sys.executable, "-m", "sonarpost.cli.main", "c2", "cot", *server, *files, "--router", router]
    process = subprocess.Popen(command)
    try:
        eventually(lambda: len({event.attrib["uid"] for event in watcher.events("b-f-t-r")}) == 2)
        uids = {event.attrib["uid"].rpartition(".")[2] for event in watcher.events("b-m-p-s-m")}
        assert uids == {"0001", "0002"}
        for event in watcher.events("b-f-t-r"):
            share = event.find("detail/fileshare")
            assert share is not None
            package = download(share.attrib["senderUrl"], certificates)
            assert hashlib.sha256(package).hexdigest() == share.attrib["sha256"]
            names = zipfile.ZipFile(io.BytesIO(package)).namelist()
            assert sum(name.endswith(".png") for name in names) == 1
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
    finally:
        process.kill()
        process.wait()
        watcher.close()
