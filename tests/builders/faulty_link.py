"""TCP link between two routers that a test can cut, stall or limit in bandwidth."""

import contextlib
import selectors
import socket
import struct
import threading

CHUNK_BYTES = 4096
POLL_S = 0.02
_RESET_ON_CLOSE = struct.pack("ii", 1, 0)


class FaultyLink:
    """Forwards connections to a port of this host, in two directions: `up` to the target and `down` from it.

    - `cut` resets every connection (RST) and refuses new ones until `mend`.
    - `stall` is a black hole: no data passes, without an error. Data in transit arrives after `mend`, as TCP
      retransmits it, unless an end has closed the connection.

    Attributes:
        attempts: Connections that were opened or refused so far.
        passed_bytes: Bytes that each direction has forwarded.

    Args:
        target_port: Port of the target.
        bytes_per_s: Bandwidth of each direction; None for no limit.
        on_fault: Called with the name of each fault, and of its end.
    """

    def __init__(self, target_port, bytes_per_s=None, on_fault=lambda _: None):
        self._on_fault = on_fault
        self._target_port = target_port
        self._bytes_per_s = bytes_per_s
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._closing = threading.Event()
        self._refusing = threading.Event()
        self._stalled = {"up": threading.Event(), "down": threading.Event()}
        self._sockets = set()
        self._lock = threading.Lock()
        self.attempts = 0
        self.passed_bytes = {"up": 0, "down": 0}
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self):
        """Reset every connection, and every new one at once."""
        self._on_fault("cut")
        self._refusing.set()
        self._reset_all()

    def stall(self, *directions):
        """Stop the data in these directions, by default in both."""
        self._on_fault(f"stall {' '.join(directions)}".strip())
        for direction in directions or ("up", "down"):
            self._stalled[direction].set()

    def mend(self):
        """Restore the link."""
        self._on_fault("restored")
        for stalled in self._stalled.values():
            stalled.clear()
        self._refusing.clear()

    def reset(self):
        """Reset every connection, which loses the data in transit; new connections are accepted."""
        self._on_fault("reset")
        self._reset_all()

    def close(self):
        self._closing.set()
        self._listener.close()
        self._reset_all()

    def _reset_all(self):
        with self._lock:
            ends, self._sockets = self._sockets, set()
        for end in ends:
            with contextlib.suppress(OSError):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
                end.shutdown(socket.SHUT_RDWR)

    def _accept(self):
        while not self._closing.is_set():
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self.attempts += 1
            try:
                if self._refusing.is_set():
                    raise ConnectionRefusedError
                far = socket.create_connection(("127.0.0.1", self._target_port), timeout=2)
                far.settimeout(None)
            except OSError:
                near.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
                near.close()
                continue
            with self._lock:
                self._sockets |= {near, far}
            pair = [
                threading.Thread(target=self._pump, args=(near, far, "up"), daemon=True),
                threading.Thread(target=self._pump, args=(far, near, "down"), daemon=True),
            ]
            for thread in pair:
                thread.start()
            threading.Thread(target=self._close_after, args=(pair, near, far), daemon=True).start()

    def _close_after(self, pair, near, far):
        for thread in pair:
            thread.join()
        with self._lock:
            self._sockets -= {near, far}
        near.close()
        far.close()

    def _pump(self, source, target, direction):
        with selectors.DefaultSelector() as selector:
            selector.register(source, selectors.EVENT_READ)
            try:
                while not self._closing.is_set():
                    if not selector.select(0.5):
                        continue
                    data = source.recv(CHUNK_BYTES)
                    while self._stalled[direction].is_set() and not self._closing.is_set():
                        self._closing.wait(POLL_S)
                    if not data:
                        break
                    target.sendall(data)
                    self.passed_bytes[direction] += len(data)
                    if self._bytes_per_s is not None:
                        self._closing.wait(len(data) / self._bytes_per_s)
            except OSError:
                pass  # one end is closed; the other one is closed below
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
