"""Upload of data packages to the HTTP interface of a TAK server."""

from __future__ import annotations

import hashlib
import uuid
from typing import Final
from urllib.parse import urlencode, urlsplit

from sonarpost.errors import ConfigError, PortError
from sonarpost.extensions.tak.data_package import UploadedPackage
from sonarpost.network import http_client
from sonarpost.security.client_tls import TlsFiles

_EXPECTED: Final = "https://host:port or http://host:port"


class PackageRefusedError(PortError):
    """The server has not accepted a package."""


class TakFiles:
    """Uploads data packages with `POST /Marti/sync/missionupload`.

    Args:
        url: Address of the server, `https://host:8443` or `http://host:8080`.
        tls: Files for `https`; the server's certificate and name are verified.
        timeout_s: Time limit of a whole upload.

    Raises:
        ConfigError: The address or a file of `tls` is invalid.
    """

    def __init__(self, url: str, tls: TlsFiles | None = None, timeout_s: float = 15.0) -> None:
        try:
            parts = urlsplit(url)
            host, _ = parts.hostname, parts.port
        except ValueError as error:
            raise ConfigError("TAK server", "", url, _EXPECTED) from error
        if parts.scheme not in ("http", "https") or not host or parts.path.strip("/") or parts.query or parts.username:
            raise ConfigError("TAK server", "", url, _EXPECTED)
        self.url = f"{parts.scheme}://{parts.netloc}"
        self._context = (tls or TlsFiles()).context() if parts.scheme == "https" else None
        self._server_name = (tls or TlsFiles()).server_name or host
        self._timeout_s = timeout_s

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
                timeout_s=self._timeout_s,
            )
        except OSError as error:
            raise PortError(f"{self.url}: package not uploaded: {str(error) or type(error).__name__}") from error
        if not 200 <= reply.status < 300:
            raise PackageRefusedError(f"{self.url}: package not uploaded: status {reply.status} {reply.reason}")
        return UploadedPackage(f"{self.url}/Marti/sync/content?hash={digest}", digest, len(package))
