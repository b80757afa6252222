"""Shore side of a message bearer, as RockBLOCK's gateway offers it over HTTP.

Messages from a terminal arrive as a POST to a web address of the shore site (the webhook). Messages to a terminal are
a POST to the gateway.
"""

import hmac
import logging
import math
import re
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final
from urllib.parse import parse_qs, urlencode, urlsplit

from sonarpost.errors import BadInputError, DeliveryError
from sonarpost.limits import limit
from sonarpost.network import http_client
from sonarpost.network.connections import ConnectionLimits, LimitedHandler, LimitedServer

log = logging.getLogger(__name__)

MAX_BODY_BYTES: Final = limit(
    4096, "bytes", "claims", "webhook", "client", "body of a request", "the request is refused"
)
MAX_FIELDS: Final = 20
MAX_MT_BYTES: Final = 270
MAX_CONNECTIONS: Final = limit(
    64, "connections", "shares", "webhook", "all clients", "connections", "an idle one is closed, or 503"
)
MAX_CONNECTIONS_OF_ADDRESS: Final = limit(
    16, "connections", "shares", "webhook", "address", "those of an address", "an idle one is closed, or 503"
)
_IMEI = re.compile(r"[0-9]{15}")
_HEX = re.compile(r"(?:[0-9a-fA-F]{2}){0,340}")


class WebhookError(BadInputError):
    """A request to the webhook is invalid."""


@dataclass(frozen=True, slots=True)
class TerminalMessage:
    """A message of a terminal.

    Attributes:
        imei: Terminal, 15 digits.
        momsn: Sequence number that the network has assigned (0..65535).
        data: Content, 0 to 340 bytes.
    """

    imei: str
    momsn: int
    data: bytes


def parse_webhook(body: bytes) -> TerminalMessage:
    """Parse the form of a request; fields that sonarpost does not use (time, position) are ignored.

    Raises:
        WebhookError: A field is missing or invalid.
    """
    where = "webhook"
    try:
        fields = parse_qs(body.decode("ascii"), keep_blank_values=True, max_num_fields=MAX_FIELDS)
    except ValueError as error:
        raise WebhookError(where, "body", body[:40], f"a form of at most {MAX_FIELDS} fields") from error
    values = {name: found[0] for name, found in fields.items() if len(found) == 1}
    imei, momsn, data = values.get("imei", ""), values.get("momsn", ""), values.get("data", "-")
    if not _IMEI.fullmatch(imei):
        raise WebhookError(where, "imei", imei, "15 digits")
    if not (momsn.isascii() and momsn.isdigit() and len(momsn) <= 5 and int(momsn) <= 0xFFFF):
        raise WebhookError(where, "momsn", momsn, "0 to 65535")
    if not _HEX.fullmatch(data):
        raise WebhookError(where, "data", data, "0 to 340 bytes in hexadecimal")
    return TerminalMessage(imei, int(momsn), bytes.fromhex(data))


Receive = Callable[[TerminalMessage], None]
"""Stores a message durably. Raises BadInputError to refuse it, DeliveryError to have the gateway repeat it."""


class Webhook:
    """HTTP server to which the gateway delivers messages: `POST /{token}`.

    It replies 200 after `receive` has returned, 400 to what is invalid, 404 without the token, 503 if the message
    cannot be stored at present, and 500 after an unexpected exception: the gateway then repeats it.

    Args:
        host: Address to listen on. The server has no TLS: a reverse proxy adds it.
        port: Port, 0 for any.
        token: Shared secret, part of the address that is entered at the gateway.
        receive: Called for each message, from several threads.
    """

    def __init__(self, host: str, port: int, token: str, receive: Receive) -> None:
        handler = type("Handler", (_WebhookHandler,), {"token": token, "receive": staticmethod(receive)})
        limits = ConnectionLimits(max_connections=MAX_CONNECTIONS, max_of_address=MAX_CONNECTIONS_OF_ADDRESS)
        self._server = LimitedServer((host, port), handler, limits)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.2,), name="webhook", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        """The port."""
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _WebhookHandler(LimitedHandler):
    token: str
    receive: Receive

    def do_POST(self) -> None:  # noqa: N802 of the base class
        """Handle one message."""
        path = urlsplit(self.path).path.removeprefix("/")
        if not hmac.compare_digest(path.encode(), self.token.encode()):
            self.reply(404, "not found")
            return
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and len(length) < 8 and int(length) <= MAX_BODY_BYTES):
            self.reply(413, f"at most {MAX_BODY_BYTES} bytes with a Content-Length")
            return
        body = self.rfile.read(int(length))
        if len(body) < int(length):
            self.reply(400, "incomplete body")
            return
        self.set_deadline(math.inf)
        try:
            type(self).receive(parse_webhook(body))
        except BadInputError as error:
            self.reply(400, str(error))
        except DeliveryError as error:
            self.reply(503, str(error))
        except Exception:
            log.exception("Message not stored after an unexpected exception")
            self.reply(500, "internal error")
        else:
            self.reply(200, "OK")


@dataclass(frozen=True, slots=True)
class RockBlockAccount:
    """Access to the gateway, to send messages to terminals.

    Attributes:
        url: Address of the gateway's MT interface, http or https.
        username: Name of the account.
        password: Its password.
    """

    url: str
    username: str
    password: str

    def send(self, imei: str, data: bytes) -> None:
        """Send a message to a terminal.

        Raises:
            DeliveryError: The gateway is not reached, or refuses it.
        """
        if not 1 <= len(data) <= MAX_MT_BYTES:
            raise DeliveryError(f"message to {imei}: {len(data)} bytes, expected 1 to {MAX_MT_BYTES}")
        form: Mapping[str, str] = {
            "imei": imei,
            "username": self.username,
            "password": self.password,
            "data": data.hex(),
        }
        host = urlsplit(self.url).hostname
        content_type = {"Content-Type": "application/x-www-form-urlencoded"}
        try:
            reply = http_client.post(self.url, urlencode(form).encode(), content_type, reads_body=True)
        except OSError as error:
            raise DeliveryError(f"gateway {host}: {error}") from error
        text = reply.body.decode("utf-8", "replace").strip()
        # "OK,12345678" or "FAILED,10,Invalid login credentials"
        if reply.status != 200 or not text.startswith("OK"):
            raise DeliveryError(f"gateway {host}: status {reply.status} {text[:100]}")
