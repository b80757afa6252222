"""TCP link between two ports of this host with a rate, a delay, a buffer, and faults."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from typing_extensions import override

PACKET_BYTES: Final = 512
SOCKET_BUFFER_BYTES: Final = 4096
SEGMENT_BYTES: Final = 1400
"""TCP's maximum segment, as on Ethernet. With that of the loopback interface, Linux gives the sender 4 MB of buffer."""
CONNECT_TIMEOUT_S: Final = 2.0
HOST: Final = "127.0.0.1"
UP: Final = "up"
DOWN: Final = "down"
_RESET_ON_CLOSE: Final = struct.pack("ii", 1, 0)


class SerialLine:
    """Arrival times of packets on a line in one direction. Pure: the time is an argument.

    Each packet occupies the line for its size divided by the rate. It arrives after the delay and a random jitter, in
    order.

    Args:
        rate_bytes_per_s: Above 0; None for no limit. It can be changed.
        delay_s: Time of a byte on the line, 0 or more. It can be changed.
        jitter_s: Largest additional delay, uniformly distributed from 0.
        seed: Of the jitter.
    """

    def __init__(self, rate_bytes_per_s: float | None, delay_s: float, jitter_s: float, seed: int) -> None:
        self.rate_bytes_per_s = rate_bytes_per_s
        self.delay_s = delay_s
        self._jitter_s = jitter_s
        self._random = random.Random(seed)
        self.clear()

    def clear(self) -> None:
        """Discard the packets on the line."""
        self._free_at_s = self._last_arrival_s = float("-inf")

    def queue_s(self, now_s: float) -> float:
        """Return how long the packets on the line still occupy it."""
        return max(0.0, self._free_at_s - now_s)

    def arrival_s(self, size_bytes: int, now_s: float) -> float:
        """Return the time of arrival of a packet that waits for the line from now on."""
        duration_s = 0.0 if self.rate_bytes_per_s is None else size_bytes / self.rate_bytes_per_s
        self._free_at_s = max(now_s, self._free_at_s) + duration_s
        arrival_s = self._free_at_s + self.delay_s + self._random.uniform(0.0, self._jitter_s)
        self._last_arrival_s = max(self._last_arrival_s, arrival_s)
        return self._last_arrival_s


@dataclass
class _Direction:
    line: SerialLine
    limit_bytes: float
    is_stalled: bool = False
    passed_bytes: int = 0


class _End(asyncio.BufferedProtocol):
    """One end of a connection. What it receives goes over the line, to the other end."""

    other: _End
    transport: asyncio.Transport | None = None

    def __init__(self, direction: _Direction) -> None:
        self._direction = direction
        self._loop = asyncio.get_running_loop()
        self._buffer = bytearray(PACKET_BYTES)
        self._in_transit: deque[tuple[float, bytes]] = deque()
        self._in_transit_bytes = 0
        self._timer: asyncio.TimerHandle | None = None
        self._has_ended = False
        self.is_blocked = False
        self.is_done = False
        self.is_closed = False

    @override
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.set_write_buffer_limits(0)
        self.transport = transport
        if self.is_closed:
            self.reset()

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        self.is_closed = True
        if exc is not None:
            self.other.reset()

    @override
    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    @override
    def buffer_updated(self, nbytes: int) -> None:
        self._send(bytes(self._buffer[:nbytes]))

    @override
    def eof_received(self) -> bool:
        self._has_ended = True
        self._send(b"")
        return True

    @override
    def pause_writing(self) -> None:
        self.is_blocked = True

    @override
    def resume_writing(self) -> None:
        self.is_blocked = False
        self.other.update()

    def _send(self, packet: bytes) -> None:
        self._in_transit.append((self._direction.line.arrival_s(len(packet), self._loop.time()), packet))
        self._in_transit_bytes += len(packet)
        self.update()

    def update(self) -> None:
        """Deliver the packets that have arrived; receive more if there is space."""
        if self.is_closed or self.transport is None or self.other.transport is None:
            return
        if self._timer is not None:
            self._timer.cancel()
        is_stalled = self._direction.is_stalled
        while self._in_transit and not is_stalled and not self.other.is_blocked:
            arrival_s, packet = self._in_transit[0]
            if arrival_s > self._loop.time():
                self._timer = self._loop.call_at(arrival_s, self.update)
                break
            self._in_transit.popleft()
            self._in_transit_bytes -= len(packet)
            self._direction.passed_bytes += len(packet)
            if packet:
                self.other.transport.write(packet)
            else:
                self._end_of_data(self.transport, self.other.transport)
        if is_stalled or self._in_transit_bytes >= self._direction.limit_bytes:
            self.transport.pause_reading()
        elif not self._has_ended:
            self.transport.resume_reading()

    def _end_of_data(self, own: asyncio.Transport, other: asyncio.Transport) -> None:
        self.is_done = True
        other.write_eof()
        if self.other.is_done:
            own.close()
            other.close()

    def reset(self) -> None:
        """Close with RST; the data in transit is lost."""
        self.is_closed = True
        if self.transport is not None:
            _reset_on_close(self.transport.get_extra_info("socket"))
            self.transport.abort()


class LinkEmulator:
    """Forwards connections to a port of this host, in two directions: `up` to the target and `down` from it.

    The connections share one serial line in each direction. Data without space in the buffer stays in the socket of its
    sender (TCP flow control).

    - `cut` resets every connection (RST), which loses the data in transit, and refuses new ones until `mend`.
    - `stall` is a black hole: no data passes, without an error. Data in transit arrives after `mend`, as TCP
      retransmits it, unless an end has closed the connection.

    The kernel has more buffers before the link, which `buffer_bytes` does not limit: 8 kB of the emulator's socket, and
    the send buffer of the sending process. The latter holds 50 to 300 kB, as on Ethernet, unless that process sets
    SO_SNDBUF.

    Attributes:
        port: Port to connect to.
        attempts: Connections that were opened or refused so far.

    Args:
        target_port: Port of the target.
        rate_bytes_per_s: Of each direction, above 0; None for no limit.
        delay_s: One-way delay.
        jitter_s: Largest additional delay of a packet, uniformly distributed from 0.
        buffer_bytes: Bytes of a connection and direction that may wait for the line, in addition to those that the line
            carries (rate times delay). One packet of 512 bytes may exceed it.
        seed: Of the jitter.
        on_fault: Called with the name of each fault, and of its end.
    """

    def __init__(
        self,
        target_port: int,
        *,
        rate_bytes_per_s: float | None = None,
        delay_s: float = 0.0,
        jitter_s: float = 0.0,
        buffer_bytes: int = 16384,
        seed: int = 0,
        on_fault: Callable[[str], object] = lambda _: None,
    ) -> None:
        limit_bytes = buffer_bytes + (rate_bytes_per_s or 0.0) * delay_s
        self.attempts = 0
        self._directions = {
            name: _Direction(SerialLine(rate_bytes_per_s, delay_s, jitter_s, 2 * seed + n), limit_bytes)
            for n, name in enumerate((UP, DOWN))
        }
        self._target_port = target_port
        self._on_fault = on_fault
        self._refusing = self._is_closing = False
        self._ends: list[_End] = []
        self._listener = _new_socket()
        self._listener.bind((HOST, 0))
        self._listener.listen()
        self.port = int(self._listener.getsockname()[1])
        self._loop = asyncio.new_event_loop()
        self._accepting = self._loop.create_task(self._accept())
        self._thread = threading.Thread(target=self._run, name=f"link-{self.port}", daemon=True)
        self._thread.start()

    @property
    def passed_bytes(self) -> dict[str, int]:
        """Bytes that were delivered so far, by direction."""
        return {name: direction.passed_bytes for name, direction in self._directions.items()}

    def cut(self) -> None:
        """Reset every connection, and every new one at once."""
        self._on_fault("cut")
        self._refusing = True
        self._in_loop(self._reset_all)

    def stall(self, *directions: str) -> None:
        """Stop the data in these directions, by default in both."""
        self._on_fault(f"stall {' '.join(directions)}".strip())
        for name in directions or (UP, DOWN):
            self._directions[name].is_stalled = True
        self._in_loop(self._update_all)

    def mend(self) -> None:
        """Restore the link."""
        self._on_fault("restored")
        self._refusing = False
        for direction in self._directions.values():
            direction.is_stalled = False
        self._in_loop(self._update_all)

    def reset(self) -> None:
        """Reset every connection, which loses the data in transit; new connections are accepted."""
        self._on_fault("reset")
        self._in_loop(self._reset_all)

    def close(self) -> None:
        """Reset every connection and close the port; a second call has no effect."""
        if self._thread.is_alive():
            self._refusing = True
            self._is_closing = True
            with contextlib.suppress(OSError), socket.create_connection((HOST, self.port), CONNECT_TIMEOUT_S):
                pass  # ends the wait for a connection: if it were cancelled, an accepted socket could stay open
            self._thread.join()

    def _run(self) -> None:
        self._loop.run_until_complete(self._accepting)
        self._reset_all()
        self._loop.run_until_complete(asyncio.sleep(0))  # closes the sockets of ended connections
        self._listener.close()
        self._loop.close()

    def _in_loop(self, action: Callable[[], None]) -> None:
        """Run an action in the thread of the link, and wait for its end."""

        async def run() -> None:
            action()

        asyncio.run_coroutine_threadsafe(run(), self._loop).result()

    def _update_all(self) -> None:
        for end in self._ends:
            end.update()

    def _reset_all(self) -> None:
        for end in self._ends:
            end.reset()
        self._ends.clear()
        for direction in self._directions.values():
            direction.line.clear()

    async def _accept(self) -> None:
        while True:
            near, _ = await self._loop.sock_accept(self._listener)
            if self._is_closing:
                near.close()
                return
            self.attempts += 1
            up, down = (_End(direction) for direction in self._directions.values())
            up.other, down.other = down, up
            self._ends = [end for end in self._ends if not end.is_closed] + [up, down]
            far = _new_socket()
            try:
                await self._reach_target(far, up)
            except OSError:
                for one in (near, far):
                    _reset_on_close(one)
                    one.close()
            else:
                await self._forward(up, near)
                await self._forward(down, far)
                self._update_all()

    async def _forward(self, end: _End, one: socket.socket) -> None:
        await self._loop.create_connection(lambda: end, sock=one)

    async def _reach_target(self, far: socket.socket, up: _End) -> None:
        if not self._refusing:
            async with asyncio.timeout(CONNECT_TIMEOUT_S):
                await self._loop.sock_connect(far, (HOST, self._target_port))
        if self._refusing or up.is_closed:
            raise ConnectionRefusedError


def _new_socket() -> socket.socket:
    one = socket.socket()
    one.settimeout(0)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, SOCKET_BUFFER_BYTES)
    one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SOCKET_BUFFER_BYTES)
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_MAXSEG, SEGMENT_BYTES)
    return one


def _reset_on_close(one: socket.socket) -> None:
    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
