"""TAK data packages, their upload, and file transfer events."""

import hashlib
import io
import threading
import zipfile
from dataclasses import replace
from email import message_from_bytes
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit
from xml.etree import ElementTree as ET

import pytest
import xmlschema
from builders.common import free_port
from builders.exports import decision, image, mission, store
from builders.tls_authority import Authority

from sonarpost.errors import ConfigError, PortError
from sonarpost.export.contacts import load_contacts
from sonarpost.export.formats import write_export
from sonarpost.extensions.tak.data_package import (
    MANIFEST,
    TakFiles,
    UploadedPackage,
    attachment_sha256,
    data_package,
    file_transfer_event,
)
from sonarpost.security.client_tls import TlsFiles

NOW_S = 1_700_000_000.0


@pytest.fixture(scope="module")
def schema():
    return xmlschema.XMLSchema(Path(__file__).with_name("cot_event.xsd"))


@pytest.fixture
def contacts(tmp_path):
    return load_contacts(mission(tmp_path / "out"))


def parameters(element):
    return {p.attrib["name"]: p.attrib["value"] for p in element.findall("Parameter")}


def test_package_has_every_event_with_its_image(contacts, tmp_path, schema):
    path = tmp_path / "contacts.tak.zip"
    assert write_export("tak.zip", path, contacts) == []
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        manifest = ET.fromstring(archive.read(MANIFEST))
        entries = {c.attrib["zipEntry"]: parameters(c) for c in manifest.findall("Contents/Content")}
        assert sorted([*entries, MANIFEST]) == sorted(archive.namelist())
        files = {name: archive.read(name) for name in entries}
    assert (manifest.tag, manifest.attrib) == ("MissionPackageManifest", {"version": "2"})
    assert set(parameters(manifest.find("Configuration") or ET.Element("none"))) == {"uid", "name"}
    events = {name: ET.fromstring(data) for name, data in files.items() if name.endswith(".cot")}
    assert {event.attrib["uid"] for event in events.values()} == {c.uid for c in contacts.located}
    for name, event in events.items():
        schema.validate(event)
        assert entries[name]["uid"] == event.attrib["uid"]
    images = {entries[name]["uid"]: data for name, data in files.items() if name.endswith(".png")}
    assert images == {c.uid: c.image_path.read_bytes() for c in contacts.located if c.image_path}
    for event in events.values():
        found = event.find("detail/attachment_list")
        png = images.get(event.attrib["uid"])
        assert (None if found is None else found.attrib["hashes"]) == (png and f'["{attachment_sha256(png)}"]')
    # An unreadable image is reported, and its event is kept.
    lost = next(c for c in contacts.located if c.image_path)
    lost.image_path.unlink()
    assert len(write_export("tak.zip", path, contacts)) == 1
    with zipfile.ZipFile(path) as archive:
        assert f"{lost.uid}/{lost.uid}.cot" in archive.namelist()


def test_hostile_text_stays_text(tmp_path):
    remark = '<x/>&"\x00</remarks>]]>'
    stored = load_contacts(store(tmp_path / "out", image(), decision(remark=remark, mlo_class="../../x")))
    [contact] = stored.contacts
    with zipfile.ZipFile(io.BytesIO(data_package(contact, b"png", NOW_S))) as archive:
        assert all(".." not in name and not name.startswith("/") for name in archive.namelist())
        event = ET.fromstring(archive.read(f"{contact.uid}/{contact.uid}.cot"))
    assert "<x/>" in (event.findtext("detail/remarks") or "")


def test_file_transfer_names_the_package(contacts, schema):
    contact = contacts.located[0]
    package = data_package(contact, b"png", NOW_S)
    uploaded = UploadedPackage("https://tak/x?hash=1&a=2", hashlib.sha256(package).hexdigest(), len(package))
    event = ET.fromstring(file_transfer_event(contact, uploaded, "sonarpost", NOW_S))
    schema.validate(event)
    share = event.find("detail/fileshare")
    assert (event.attrib["type"], share.attrib["senderUrl"]) == ("b-f-t-r", uploaded.url)
    assert (share.attrib["sha256"], share.attrib["sizeInBytes"]) == (uploaded.sha256, str(len(package)))


class Marti(BaseHTTPRequestHandler):
    """The upload of a TAK server: checks the digest in the address against the file."""

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        head = f"Content-Type: {self.headers['Content-Type']}\r\n\r\n".encode()
        [part] = message_from_bytes(head + body).get_payload()
        data = part.get_payload(decode=True)
        split = urlsplit(self.path)
        query = {name: values[0] for name, values in parse_qs(split.query).items()}
        name = part.get_param("name", header="content-disposition")
        is_valid = split.path == "/Marti/sync/missionupload" and name == "assetfile"
        is_valid = is_valid and query["hash"] == hashlib.sha256(data).hexdigest()
        self.server.uploads.append((query["filename"], data))
        self.send_response(self.server.status if is_valid else 400)
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def marti():
    server = HTTPServer(("127.0.0.1", 0), Marti)
    server.uploads, server.status = [], 200
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def test_upload(contacts, marti):
    package = data_package(contacts.located[0], b"png\r\n--x\r\n", NOW_S)
    url = f"http://127.0.0.1:{marti.server_port}"
    uploaded = TakFiles(url, TlsFiles()).upload("a.zip", package, "sonarpost")
    assert marti.uploads == [("a.zip", package)]
    assert uploaded.url == f"{url}/Marti/sync/content?hash={hashlib.sha256(package).hexdigest()}"
    marti.status = 500
    with pytest.raises(PortError, match="status 500"):
        TakFiles(url, TlsFiles()).upload("a.zip", package, "sonarpost")


def test_upload_by_tls_to_a_server_with_another_name(tmp_path, marti):
    authority = Authority(tmp_path)
    context, files = authority.server_context(hosts=("takserver",)), authority.issue("client")
    marti.socket = context.wrap_socket(marti.socket, server_side=True)
    url = f"https://127.0.0.1:{marti.server_port}"
    with pytest.raises(PortError, match=r"not uploaded: .*IP address mismatch"):
        TakFiles(url, files).upload("a.zip", b"zip", "sonarpost")
    TakFiles(url, replace(files, server_name="takserver")).upload("a.zip", b"zip", "sonarpost")
    assert marti.uploads == [("a.zip", b"zip")]


def test_unreached_server_and_invalid_address_are_errors():
    with pytest.raises(PortError, match="not uploaded"):
        TakFiles(f"http://127.0.0.1:{free_port()}", TlsFiles()).upload("a.zip", b"", "sonarpost")
    for url in ("ftp://a", "https://", "https://a:x", "https://u@a", "https://a/path"):
        with pytest.raises(ConfigError, match="TAK server"):
            TakFiles(url, TlsFiles())
