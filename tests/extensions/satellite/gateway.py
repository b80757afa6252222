"""Emulated satellite message service: terminals of the Iridium 9602 class, and RockBLOCK's gateway over HTTP.

Every terminal is a TCP port with AT commands. The gateway delivers their messages to a webhook and repeats a delivery
that is not answered with 200. It accepts messages to terminals as RockBLOCK does. Messages are lost and delayed at
random, by a seed. Not modelled: antennas and visibility, sessions that fail, RING alerts.
"""

import heapq
import re
import threading
import time
from collections import deque
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count
from random import Random
from socketserver import StreamRequestHandler, TCPServer, ThreadingTCPServer
from urllib.parse import parse_qs, urlencode

from sonarpost.network import http_client

MAX_MO_BYTES = 340
MAX_MT_BYTES = 270
RETRY_S = 0.2


class MessageGatewayEmulator:
    """Terminals and gateway on loopback.

    Args:
        webhook_url: Address to which messages of terminals are delivered.
        imeis: The terminals.
        loss: Fraction of the messages, in both directions, that the sender sees as sent and that never arrive (0..1).
        max_delay_s: Longest delay of a message from a terminal; delays are random, so that messages change their order.
        seed: Seed of the random numbers.
        account: Name and password of the account.
    """

    def __init__(
        self,
        webhook_url: str,
        imeis: Sequence[str],
        *,
        loss: float = 0.0,
        max_delay_s: float = 0.0,
        seed: int = 0,
        account: tuple[str, str] = ("user", "password"),
    ) -> None:
        self.webhook_url = webhook_url
        self.account = account
        self.sent_bytes = 0
        self.messages = 0
        self.lost = 0
        self._loss = loss
        self._max_delay_s = max_delay_s
        self._random = Random(seed)
        self._lock = threading.Lock()
        self._mailboxes: dict[str, deque[bytes]] = {imei: deque() for imei in imeis}
        self._momsn = dict.fromkeys(imeis, 0)
        self._deliveries: list[tuple[float, int, dict[str, str]]] = []
        self._order = count()
        self._stop = threading.Event()
        self._terminals = {imei: _TerminalServer(self, imei) for imei in imeis}
        self._http = _GatewayServer(self)
        servers: list[TCPServer] = [*self._terminals.values(), self._http]
        self._servers = servers
        self._threads = [threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True) for server in servers]
        self._threads.append(threading.Thread(target=self._deliver, daemon=True))
        for thread in self._threads:
            thread.start()

    def terminal_url(self, imei: str) -> str:
        """Return the pyserial URL of a terminal."""
        return f"socket://127.0.0.1:{self._terminals[imei].server_address[1]}"

    @property
    def mt_url(self) -> str:
        """Address that accepts messages to terminals."""
        return f"http://127.0.0.1:{self._http.server_address[1]}/rockblock/MT"

    def from_terminal(self, imei: str, data: bytes) -> int:
        """Take over a message of a terminal; return its number."""
        with self._lock:
            self._momsn[imei] = (self._momsn[imei] + 1) & 0xFFFF
            self.messages += 1
            self.sent_bytes += len(data)
            form = {
                "imei": imei,
                "serial": "12345",
                "momsn": str(self._momsn[imei]),
                "transmit_time": time.strftime("%y-%m-%d %H:%M:%S", time.gmtime()),
                "iridium_latitude": "50.1234",
                "iridium_longitude": "-1.2345",
                "iridium_cep": "8",
                "data": data.hex(),
            }
            if self._random.random() < self._loss:
                self.lost += 1
            else:
                due_s = time.monotonic() + self._random.uniform(0, self._max_delay_s)
                heapq.heappush(self._deliveries, (due_s, next(self._order), form))
            return self._momsn[imei]

    def to_terminal(self, imei: str, data: bytes) -> bool:
        """Take over a message to a terminal; return whether the terminal exists."""
        with self._lock:
            if imei not in self._mailboxes:
                return False
            if self._random.random() < self._loss:
                self.lost += 1
            else:
                self._mailboxes[imei].append(data)
            return True

    def mailbox(self, imei: str) -> tuple[bytes | None, int]:
        """Return the next message to a terminal, and how many are left."""
        with self._lock:
            mailbox = self._mailboxes[imei]
            return (mailbox.popleft() if mailbox else None), len(mailbox)

    def _deliver(self) -> None:
        while not self._stop.wait(0.005):
            with self._lock:
                due = bool(self._deliveries) and self._deliveries[0][0] <= time.monotonic()
                delivery = heapq.heappop(self._deliveries) if due else None
            if delivery is not None and not self._post(delivery[2]):
                with self._lock:
                    heapq.heappush(self._deliveries, (time.monotonic() + RETRY_S, delivery[1], delivery[2]))

    def _post(self, form: dict[str, str]) -> bool:
        content_type = {"Content-Type": "application/x-www-form-urlencoded"}
        try:
            return http_client.post(self.webhook_url, urlencode(form).encode(), content_type).status == 200
        except OSError:
            return False

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        for server in self._servers:
            server.shutdown()
            server.server_close()
        for thread in self._threads:
            thread.join()


class _TerminalServer(ThreadingTCPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, gateway: MessageGatewayEmulator, imei: str) -> None:
        self.gateway = gateway
        self.imei = imei
        super().__init__(("127.0.0.1", 0), _Terminal)


class _Terminal(StreamRequestHandler):
    """One connection to a terminal, with echo as after a reset."""

    server: _TerminalServer

    def handle(self) -> None:
        """Answer commands until the connection ends."""
        echo, outgoing, incoming, mtmsn = True, b"", b"", 0
        while line := self._command():
            if echo:
                self.wfile.write(line + b"\r")
            if line == b"ATE0":
                echo = False
            elif line == b"AT+SBDD0":
                outgoing = b""
                self.wfile.write(b"\r\n0\r\n")
            elif match := re.fullmatch(rb"AT\+SBDWB=(\d{1,3})", line):
                size = int(match[1])
                if not 1 <= size <= MAX_MO_BYTES:
                    self.wfile.write(b"\r\n3\r\n\r\nOK\r\n")
                    continue
                self.wfile.write(b"\r\nREADY\r\n")
                data = self.rfile.read(size + 2)
                good = sum(data[:size]) & 0xFFFF == int.from_bytes(data[size:], "big")
                outgoing = data[:size] if good else b""
                self.wfile.write(b"\r\n0\r\n" if good else b"\r\n2\r\n")
            elif line == b"AT+SBDIX":
                gateway, imei = self.server.gateway, self.server.imei
                momsn = gateway.from_terminal(imei, outgoing) if outgoing else 0
                found, left = gateway.mailbox(imei)
                incoming, mtmsn = found or b"", mtmsn + bool(found)
                status = (0, momsn, int(found is not None), mtmsn, len(incoming), left)
                self.wfile.write(b"\r\n+SBDIX: " + ", ".join(map(str, status)).encode() + b"\r\n")
            elif line == b"AT+SBDRB":
                checksum = (sum(incoming) & 0xFFFF).to_bytes(2, "big")
                self.wfile.write(len(incoming).to_bytes(2, "big") + incoming + checksum)
            elif line != b"AT":
                self.wfile.write(b"\r\nERROR\r\n")
                continue
            self.wfile.write(b"\r\nOK\r\n")

    def _command(self) -> bytes:
        line = b""
        while (byte := self.rfile.read(1)) not in (b"", b"\r"):
            line += byte
        return line


class _GatewayServer(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, gateway: MessageGatewayEmulator) -> None:
        self.gateway = gateway
        super().__init__(("127.0.0.1", 0), _GatewayHandler)


class _GatewayHandler(BaseHTTPRequestHandler):
    server: _GatewayServer

    def do_POST(self) -> None:
        """Accept a message to a terminal."""
        body = self.rfile.read(int(self.headers["Content-Length"]))
        form = {name: values[0] for name, values in parse_qs(body.decode()).items()}
        data = bytes.fromhex(form.get("data", ""))
        if (form.get("username"), form.get("password")) != self.server.gateway.account:
            reply = "FAILED,10,Invalid login credentials"
        elif not 1 <= len(data) <= MAX_MT_BYTES:
            reply = "FAILED,16,No data" if not data else "FAILED,15,Data too long"
        elif not self.server.gateway.to_terminal(form.get("imei", ""), data):
            reply = "FAILED,11,No RockBLOCK with this IMEI found on your account"
        else:
            reply = "OK,12345678"
        self.send_response(200)
        self.send_header("Content-Length", str(len(reply)))
        self.end_headers()
        self.wfile.write(reply.encode())

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 of the base class
        """Log nothing."""
