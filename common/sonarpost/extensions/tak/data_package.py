"""TAK data packages: a ZIP file with a manifest of version 2, Cursor-on-Target events, and their images as attachments.

A client that imports a package adds each event to its map and attaches the image to it.
"""

import hashlib
import io
import json
import time
import uuid
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from typing import IO, Final
from urllib.parse import urlencode, urlsplit
from xml.etree import ElementTree as ET

from sonarpost.errors import ConfigError, PortError
from sonarpost.export.contacts import ExportContact
from sonarpost.export.formats import Format
from sonarpost.export.source import ExportSource, archive_entry
from sonarpost.export.text import xml_text
from sonarpost.extensions.tak.cot import cot_event, event_element
from sonarpost.network import http_client
from sonarpost.security.client_tls import TlsFiles

MANIFEST: Final = "MANIFEST/manifest.xml"
FILE_TRANSFER: Final = "b-f-t-r"
"""CoT type of a request to download a file."""
_HUMAN: Final = "h-e"
"""CoT "human, estimated": clients expect it of file transfers."""
_NAMESPACE: Final = uuid.UUID("6f4f2a0e-54b8-5b2f-9b0c-0a3c4b7d6f11")


def write_data_package(file: IO[bytes], source: ExportSource) -> None:
    """Write a data package of all contacts with a position, named after the file."""
    pairs = ((contact, source.images.png(contact)) for contact in source.contacts if contact.position is not None)
    with zipfile.ZipFile(file, "w") as archive:
        _fill(archive, source.path.name.partition(".")[0], pairs, time.time())


def data_package(contact: ExportContact, png: bytes, now_utc_s: float) -> bytes:
    """Return a data package of one contact, which has a position, with its image."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        _fill(archive, contact.name, [(contact, png)], now_utc_s)
    return buffer.getvalue()


def attachment_sha256(png: bytes) -> str:
    """Return the digest by which an event names its attachment."""
    return hashlib.sha256(png).hexdigest()


@dataclass(frozen=True, slots=True)
class UploadedPackage:
    """A data package on a server: its address for clients, its SHA-256 digest (hexadecimal), its size."""

    url: str
    sha256: str
    size_bytes: int


def file_transfer_event(contact: ExportContact, package: UploadedPackage, sender: str, now_utc_s: float) -> bytes:
    """Return the event that makes clients download a data package.

    Args:
        contact: Contact of the package, with a position.
        package: The package.
        sender: Name of the sender on the clients.
        now_utc_s: Time of sending; the event is valid for 10 minutes.
    """
    uid = str(uuid.uuid5(_NAMESPACE, package.sha256))
    event = event_element(contact, uid, FILE_TRANSFER, _HUMAN, now_utc_s, 600.0)
    detail = ET.SubElement(event, "detail")
    ET.SubElement(
        detail,
        "fileshare",
        {
            "filename": f"{file_name(contact)}.zip",
            "name": xml_text(contact.name),
            "senderCallsign": xml_text(sender),
            "senderUid": str(uuid.uuid5(_NAMESPACE, sender)),
            "senderUrl": xml_text(package.url),
            "sha256": package.sha256,
            "sizeInBytes": str(package.size_bytes),
        },
    )
    xml: bytes = ET.tostring(event, encoding="utf-8")
    return xml


def file_name(contact: ExportContact) -> str:
    """Return the name of a contact's files: vehicle, image and version."""
    return f"{contact.image.vehicle_id}_{contact.image.image_id}_v{contact.image.version}"


def _fill(
    archive: zipfile.ZipFile, name: str, contacts: Iterable[tuple[ExportContact, bytes | None]], now_utc_s: float
) -> None:
    manifest = ET.Element("MissionPackageManifest", {"version": "2"})
    configuration = ET.SubElement(manifest, "Configuration")
    contents = ET.SubElement(manifest, "Contents")
    uids: list[str] = []
    for contact, png in contacts:
        uids.append(contact.uid)
        digest = None if png is None else attachment_sha256(png)
        entry = f"{contact.uid}/{contact.uid}.cot"
        archive.writestr(archive_entry(entry), cot_event(contact, now_utc_s, digest))
        _content(contents, entry, {"uid": contact.uid, "name": contact.name})
        if png is not None:
            entry = f"{digest}/{file_name(contact)}.png"
            archive.writestr(archive_entry(entry), png)
            # A file with the identifier of an event is an attachment of it.
            _content(contents, entry, {"uid": contact.uid})
    package_uid = str(uuid.uuid5(_NAMESPACE, json.dumps([name, uids])))
    for key, value in (("uid", package_uid), ("name", name)):
        ET.SubElement(configuration, "Parameter", {"name": key, "value": xml_text(value)})
    archive.writestr(archive_entry(MANIFEST), ET.tostring(manifest, encoding="utf-8", xml_declaration=True))


def _content(contents: ET.Element, entry: str, parameters: dict[str, str]) -> None:
    content = ET.SubElement(contents, "Content", {"ignore": "false", "zipEntry": entry})
    for key, value in parameters.items():
        ET.SubElement(content, "Parameter", {"name": key, "value": xml_text(value)})


TAK_ZIP: Final = Format(write_data_package, "application/zip")


_EXPECTED: Final = "https://host:port or http://host:port"
UPLOAD_S: Final = 15.0
"""Time limit of a whole upload."""


class PackageRefusedError(PortError):
    """The server has not accepted a package."""


class TakFiles:
    """Uploads data packages with `POST /Marti/sync/missionupload`.

    Args:
        url: Address of the server, `https://host:8443` or `http://host:8080`.
        tls: Files for `https`; the server's certificate and name are verified.

    Raises:
        ConfigError: The address or a file of `tls` is invalid.
    """

    def __init__(self, url: str, tls: TlsFiles) -> None:
        try:
            parts = urlsplit(url)
            host, _ = parts.hostname, parts.port
        except ValueError as error:
            raise ConfigError("TAK server", "", url, _EXPECTED) from error
        if parts.scheme not in ("http", "https") or not host or parts.path.strip("/") or parts.query or parts.username:
            raise ConfigError("TAK server", "", url, _EXPECTED)
        self.url = f"{parts.scheme}://{parts.netloc}"
        self._context = tls.context() if parts.scheme == "https" else None
        self._server_name = tls.server_name or host

    def upload(self, name: str, package: bytes, creator: str) -> UploadedPackage:
        """Upload a package. The server identifies it by its SHA-256 digest.

        Args:
            name: File name that ends in .zip.
            package: Bytes of the ZIP file.
            creator: Identifier of the sender.

        Raises:
            PackageRefusedError: The server has replied, but has not accepted the package.
            PortError: The server is not reached.
        """
        digest = hashlib.sha256(package).hexdigest()
        query = urlencode({"hash": digest, "filename": name, "creatorUid": creator, "keyword": "missionpackage"})
        boundary = uuid.uuid4().hex
        head = (
            f"--{boundary}\r\n"
            f'Content-Disposition: form-data; name="assetfile"; filename="{name}"\r\n'
            "Content-Type: application/x-zip-compressed\r\n\r\n"
        )
        body = head.encode() + package + f"\r\n--{boundary}--\r\n".encode()
        headers = {"Content-Type": f"multipart/form-data; boundary={boundary}"}
        try:
            reply = http_client.post(
                f"{self.url}/Marti/sync/missionupload?{query}",
                body,
                headers,
                context=self._context,
                server_name=self._server_name,
                timeout_s=UPLOAD_S,
            )
        except OSError as error:
            raise PortError(f"{self.url}: package not uploaded: {str(error) or type(error).__name__}") from error
        if not 200 <= reply.status < 300:
            raise PackageRefusedError(f"{self.url}: package not uploaded: status {reply.status} {reply.reason}")
        return UploadedPackage(f"{self.url}/Marti/sync/content?hash={digest}", digest, len(package))
