"""Upload of data packages to the HTTP interface of a TAK server."""

from __future__ import annotations

import hashlib
import http.client
import uuid
from typing import Final
from urllib.parse import urlencode, urlsplit

from sonarpost.errors import ConfigError, PortError
from sonarpost.export.cot_sender import TlsFiles
from sonarpost.export.tak import UploadedPackage

MAX_REPLY_BYTES: Final = 1 << 16
_EXPECTED: Final = "https://host:port or http://host:port"


class TakFiles:
    """Uploads data packages with `POST /Marti/sync/missionupload`.

    Args:
        url: Address of the server, `https://host:8443` or `http://host:8080`.
        tls: PEM files for `https`; the server's certificate and name are verified.
        timeout_s: Time limit of connection and reply.

    Raises:
        ConfigError: The address or a file of `tls` is invalid.
    """

    def __init__(self, url: str, tls: TlsFiles | None = None, timeout_s: float = 15.0) -> None:
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise ConfigError("TAK server", "", url, _EXPECTED) from error
        if parts.scheme not in ("http", "https") or not host or parts.path.strip("/") or parts.query or parts.username:
            raise ConfigError("TAK server", "", url, _EXPECTED)
        self.url = f"{parts.scheme}://{parts.netloc}"
        self._host, self._port = host, port
        self._context = (tls or TlsFiles()).context() if parts.scheme == "https" else None
        self._timeout_s = timeout_s

    def upload(self, name: str, package: bytes, creator: str) -> UploadedPackage:
        """Upload a package. The server identifies it by its SHA-256 digest.

        Args:
            name: File name that ends in .zip.
            package: Bytes of the ZIP file.
            creator: Identifier of the sender.

        Raises:
            PortError: The server is not reached, or has not accepted the package.
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
        connection = self._connection()
        try:
            connection.request("POST", f"/Marti/sync/missionupload?{query}", body, headers)
            reply = connection.getresponse()
            reply.read(MAX_REPLY_BYTES)
        except (OSError, http.client.HTTPException) as error:
            raise PortError(f"{self.url}: package not uploaded: {str(error) or type(error).__name__}") from error
        finally:
            connection.close()
        if not 200 <= reply.status < 300:
            raise PortError(f"{self.url}: package not uploaded: status {reply.status} {reply.reason}")
        return UploadedPackage(f"{self.url}/Marti/sync/content?hash={digest}", digest, len(package))

    def _connection(self) -> http.client.HTTPConnection:
        if self._context is not None:
            return http.client.HTTPSConnection(self._host, self._port, timeout=self._timeout_s, context=self._context)
        return http.client.HTTPConnection(self._host, self._port, timeout=self._timeout_s)
