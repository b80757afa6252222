"""Ways of an alert: an HTTP webhook, an MQTT broker."""

import hashlib
import hmac
import ssl
import threading
import time
import uuid
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import SplitResult, unquote, urlsplit

from sonarpost.errors import ConfigError, PortError
from sonarpost.network import http_client
from sonarpost.security.client_tls import TlsFiles

if TYPE_CHECKING:
    # Imported when it is used: it needs the extra `mqtt`.
    from paho.mqtt.client import Client

TIMEOUT_S: Final = 10.0
"""Time limit of the connection to a broker, and of its acknowledgement."""
MIN_SECRET_BYTES: Final = 16
REFUSED_STATUS: Final = (400, 413, 422)
"""Replies that another attempt cannot change."""


class AlertRefusedError(PortError):
    """The receiver has refused an alert for good."""


class AlertNotAcceptedError(PortError):
    """The receiver has replied, but has not accepted an alert: the cause can be this alert alone."""


def read_secret(path: Path, name: str) -> bytes:
    """Read a secret: the first line of a file.

    Raises:
        ConfigError: The file cannot be read, or the secret is shorter than 16 bytes.
    """
    try:
        with path.open("rb") as file:
            secret = file.readline(4096).strip()
    except OSError as error:
        raise ConfigError("c2 alert", name, str(path), f"a readable file ({error.strerror or error})") from error
    if len(secret) < MIN_SECRET_BYTES:
        raise ConfigError("c2 alert", name, f"{len(secret)} bytes", f"at least {MIN_SECRET_BYTES} bytes")
    return secret


class AlertWebhook:
    """HTTP POST of each alert. TLS certificate and name are verified, and redirections are not followed.

    `send` returns when the receiver has accepted the alert, as that of `Mqtt` does.

    Args:
        url: `https://…` or `http://…`.
        tls: PEM files for `https`.
        secret: Key of the signature; None sends none.
        stop: Ends an exchange.

    Raises:
        ConfigError: The address or a file is invalid.
    """

    def __init__(self, url: str, tls: TlsFiles, secret: bytes | None, stop: threading.Event | None = None) -> None:
        parts = _split("--webhook", url, ("http", "https"))
        self._url = url
        self._netloc = parts.netloc
        self._secret = secret
        self._context = tls.context() if parts.scheme == "https" else None
        self._stop = stop

    def send(self, alert_id: str, vessel_id: str, body: bytes) -> None:
        """Send an alert; a reply with a status of 200 to 299 accepts it.

        Raises:
            AlertRefusedError: The receiver has refused it.
            AlertNotAcceptedError: The receiver has replied, but has not accepted it: send it again.
            PortError: The receiver was not reached or did not reply: send it again.
        """
        del vessel_id  # part of the body
        timestamp = str(int(time.time()))
        headers = {"Content-Type": "application/json", "X-Sonarpost-Id": alert_id, "X-Sonarpost-Timestamp": timestamp}
        if self._secret is not None:
            headers["X-Sonarpost-Signature"] = signature(self._secret, timestamp, body)
        try:
            reply = http_client.post(self._url, body, headers, context=self._context, stop=self._stop)
        except OSError as error:
            raise PortError(f"{self._netloc}: alert not sent: {str(error) or type(error).__name__}") from error
        if reply.status in REFUSED_STATUS:
            raise AlertRefusedError(f"{self._netloc}: alert refused: status {reply.status}")
        if not 200 <= reply.status < 300:
            raise AlertNotAcceptedError(f"{self._netloc}: alert not accepted: status {reply.status}")

    def close(self) -> None:
        """Do nothing: each alert has a connection of its own."""


class Mqtt:
    """Publishes each alert with quality of service 1 on `{topic}/{vessel}`, not retained.

    Args:
        url: `mqtt://host[:1883]/topic` or `mqtts://host[:8883]/topic`, with a user name before the host if needed.
        tls: PEM files for `mqtts`.
        password: Password of the user.

    Raises:
        ConfigError: The address or a file is invalid.
        ModuleNotFoundError: The extra `mqtt` is not installed.
    """

    def __init__(self, url: str, tls: TlsFiles, password: bytes | None) -> None:
        # Imported lazily: it needs the extra `mqtt`.
        from paho.mqtt.client import Client  # noqa: PLC0415
        from paho.mqtt.enums import CallbackAPIVersion  # noqa: PLC0415

        self._new_client = partial(Client, CallbackAPIVersion.VERSION2)
        parts = _split("--mqtt", url, ("mqtt", "mqtts"))
        self._host, self._user = parts.hostname or "", unquote(parts.username or "")
        self._port = parts.port or (8883 if parts.scheme == "mqtts" else 1883)
        self._topic = parts.path.strip("/")
        if not self._topic or set(self._topic) & set("#+"):
            raise ConfigError("c2 alert", "--mqtt", url, "a topic without wildcards behind the host")
        self._context: ssl.SSLContext | None = tls.context() if parts.scheme == "mqtts" else None
        self._password = password
        self._client: Client | None = None

    def send(self, alert_id: str, vessel_id: str, body: bytes) -> None:
        """Publish an alert; the broker's acknowledgement accepts it.

        Raises:
            PortError: The broker was not reached or did not reply: send it again.
        """
        del alert_id  # part of the body
        try:
            client = self._connected()
            published = client.publish(f"{self._topic}/{vessel_id}", body, qos=1)
            published.wait_for_publish(TIMEOUT_S)
            is_published = published.is_published()
        except (OSError, ValueError, RuntimeError) as error:
            self.close()
            raise PortError(f"{self._host}:{self._port}: alert not published: {error}") from error
        if not is_published:
            self.close()
            raise PortError(f"{self._host}:{self._port}: alert not acknowledged within {TIMEOUT_S:g} s")

    def _connected(self) -> "Client":
        if self._client is not None and self._client.is_connected():
            return self._client
        self.close()
        client = self._new_client(client_id=f"sonarpost-{uuid.uuid4().hex[:12]}")
        client.connect_timeout = TIMEOUT_S
        if self._user:
            client.username_pw_set(self._user, None if self._password is None else self._password.decode())
        if self._context is not None:
            client.tls_set_context(self._context)
        # It limits the TLS handshake as well.
        client.connect(self._host, self._port, keepalive=max(1, round(TIMEOUT_S)))
        self._client = client
        client.loop_start()
        return client

    def close(self) -> None:
        """Disconnect."""
        client, self._client = self._client, None
        if client is not None:
            client.disconnect()
            client.loop_stop()


def _split(option: str, url: str, schemes: tuple[str, str]) -> SplitResult:
    expected = f"{schemes[0]}://host[:port]/… or {schemes[1]}://host[:port]/…"
    try:
        parts = urlsplit(url)
        is_valid = parts.scheme in schemes and bool(parts.hostname) and parts.port != 0 and "#" not in url
    except ValueError as error:
        raise ConfigError("c2 alert", option, url, expected) from error
    if not is_valid or parts.password or not url.isprintable() or " " in url:
        raise ConfigError("c2 alert", option, url, expected)
    return parts


def signature(key: bytes, timestamp: str, body: bytes) -> str:
    """Return the value of the header `X-Sonarpost-Signature`: HMAC-SHA256 of timestamp, a dot and the body."""
    return "sha256=" + hmac.new(key, timestamp.encode() + b"." + body, hashlib.sha256).hexdigest()
