"""Redis: two servers with `appendfsync always`, and a forwarder between a stream of each.

Redis has no transfer of streams of its own. The forwarder reads up to 512 entries, adds them with the same identifiers
to the stream of the receiver, and deletes them at the sender when the receiver has answered. Redis answers after its
`fsync`, one for all commands that it has read together. The forwarder connects again after the loss of a connection,
and sends the same entries; the receiver rejects an identifier that is not larger than its last one.
"""

import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from typing_extensions import override

from research.common.ports import free_ports
from research.peers.base import Peer, StartError, program, server

BATCH = 512
RECONNECT_S = 1.0
STREAM = b"records"


class Connection:
    """Client of one server."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._file = self._socket.makefile("rb")

    def request(self, *commands: Sequence[bytes]) -> list[Any]:
        """Send commands together; return their answers: an integer, bytes, None or a list each.

        Raises:
            StartError: The server rejects a command, other than an identifier that it has.
            OSError: The connection has ended.
        """
        self._socket.sendall(
            b"".join(
                b"*%d\r\n%b" % (len(command), b"".join(b"$%d\r\n%b\r\n" % (len(word), word) for word in command))
                for command in commands
            )
        )
        return [self._answer() for _ in commands]

    def _answer(self) -> object:
        line = self._file.readline()
        if not line:
            raise ConnectionError("Redis closed the connection")
        kind, text = line[:1], line[1:-2]
        if kind == b"-" and b"ID specified in XADD is equal or smaller" not in text:
            raise StartError(text.decode())
        if kind == b":":
            return int(text)
        if kind == b"$":
            return None if text == b"-1" else self._file.read(int(text) + 2)[:-2]
        if kind == b"*":
            return [self._answer() for _ in range(int(text))]
        return text

    def close(self) -> None:
        """End the connection."""
        self._file.close()
        self._socket.close()


class Redis(Peer):
    """Streams with a forwarder."""

    def __init__(self, sender_port: int, receiver_port: int, link_port: int) -> None:
        self._sender_port, self._link_port = sender_port, link_port
        self._sender, self._receiver = Connection(sender_port), Connection(receiver_port)
        self._forwarder: threading.Thread | None = None
        self._is_stopped = threading.Event()

    @override
    def fill(self, payloads: Sequence[bytes]) -> None:
        """Empty both streams, then add the records to the sender's."""
        self._stop_forwarder()
        for side in (self._sender, self._receiver):
            side.request([b"DEL", STREAM])
        for start in range(0, len(payloads), BATCH):
            self._sender.request(*([b"XADD", STREAM, b"*", b"p", one] for one in payloads[start : start + BATCH]))

    @override
    def connect(self) -> None:
        """Start the forwarder."""
        self._is_stopped.clear()
        self._forwarder = threading.Thread(target=self._run, daemon=True)
        self._forwarder.start()

    @override
    def stored(self) -> int:
        """Return the length of the receiver's stream."""
        return int(self._receiver.request([b"XLEN", STREAM])[0])

    def _run(self) -> None:
        while not self._is_stopped.is_set():
            try:
                self._forward()
            except OSError:
                self._is_stopped.wait(RECONNECT_S)
            else:
                return

    def _forward(self) -> None:
        """Move all records of the sender."""
        with closing(Connection(self._link_port)) as target, closing(Connection(self._sender_port)) as source:
            while entries := source.request([b"XRANGE", STREAM, b"-", b"+", b"COUNT", b"%d" % BATCH])[0]:
                target.request(*([b"XADD", STREAM, number, *fields] for number, fields in entries))
                if self._is_stopped.is_set():
                    return
                source.request([b"XDEL", STREAM, *(number for number, _ in entries)])

    def _stop_forwarder(self) -> None:
        self._is_stopped.set()
        if self._forwarder is not None:
            self._forwarder.join()

    def close(self) -> None:
        """End the forwarder and the connections."""
        self._is_stopped.set()
        self._sender.close()
        self._receiver.close()


@contextmanager
def start(folder: Path, receiver_port: int, link_port: int) -> Iterator[Redis]:
    """Start both servers; arguments and errors: `PEERS`."""
    executable = program("redis-server", "apt-get install redis-server")
    (sender_port,) = free_ports(1)
    with ExitStack() as stack:
        for name, port in (("sender", sender_port), ("receiver", receiver_port)):
            (data := folder / name).mkdir(parents=True)
            options = f"--bind 127.0.0.1 --port {port} --dir {data} --save  --appendonly yes --appendfsync always"
            stack.enter_context(server([executable, *options.split(" ")], port, folder / f"{name}.log"))
        peer = Redis(sender_port, receiver_port, link_port)
        stack.callback(peer.close)
        yield peer
