"""A TAK server for tests, plain TCP or TLS, that can refuse, stop or ignore a client."""

import socket
import struct
import threading


class TakServer:
    """Listener that stores what it reads of each connection.

    Args:
        context: TLS; None for plain TCP.
        port: Port; 0 for a free one.
        greeting: Sent to each client at the start.
        reset_in: Number of the connection that is reset when `reset_after` bytes of it were read.
        keeps_open: Connections stay open after the end of the client.
        closes_after: Bytes of a connection after which the server closes it by itself.
    """

    def __init__(
        self, context=None, *, port=0, greeting=b"", reset_in=None, reset_after=1, keeps_open=False, closes_after=None
    ):
        self.received: list[bytearray] = []
        self.ended: list[bool] = []
        """Whether the client has ended the connection."""
        self._connections: list[socket.socket] = []
        self._context = context
        self._greeting = greeting
        self._reset_in, self._reset_after = reset_in, reset_after
        self._keeps_open, self._closes_after = keeps_open, closes_after
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def events(self):
        """Return the number of events in the connections that clients have ended."""
        return sum(data.count(b"<event") for data, ended in zip(self.received, self.ended, strict=True) if ended)

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()
        for connection in self._connections:
            connection.close()

    def _accept(self):
        while True:
            try:
                connection = self._listener.accept()[0]
            except OSError:
                return
            try:
                if self._context is not None:
                    connection = self._context.wrap_socket(connection, server_side=True)
                connection.sendall(self._greeting)
            except OSError:
                connection.close()
                continue
            self._connections.append(connection)
            self.received.append(bytearray())
            self.ended.append(False)
            threading.Thread(target=self._read, args=(connection, len(self.received) - 1), daemon=True).start()

    def _read(self, connection, number):
        data = self.received[number]
        try:
            while piece := connection.recv(4096):
                data += piece
                if number == self._reset_in and len(data) >= self._reset_after:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    connection.close()
                    return
                if self._closes_after is not None and len(data) >= self._closes_after:
                    connection.close()
                    return
        except OSError:
            return
        self.ended[number] = True
        if not self._keeps_open:
            connection.close()
