"""Blocking interface to a modem on a serial port, for scripts."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from typing import Final, Self

from sonarpost.errors import PortError, TransmissionError
from sonarpost.modem.interface import ModemEvent, PacketFailed, PacketReceived, PacketSent
from sonarpost.modem.registry import DEFAULT_DRIVER, ModemSettings, modem_driver
from sonarpost.runtime.modem_port import open_modem_port
from sonarpost.runtime.modem_runner import ModemRunner

MAX_RECEIVED_PACKETS: Final = 1000
"""Received packets that wait for `receive`; the oldest is dropped when another arrives."""


class SerialModem:
    """A modem with blocking `send` and `receive`.

        with SerialModem("/dev/ttyUSB0", address=3) as modem:
            modem.send([b"hello"], destination=1, rate=1)
            packet = modem.receive(timeout_s=30)

    A lost port is opened again and the modem configured again; packets may be sent and received afterwards.

    Args:
        url: Serial device, or another pyserial URL (`socket://host:port`, `rfc2217://host:port`).
        address: Address that the modem gets; 0 to 127 for the Micro-Modem.
        baud: Bit rate of the serial line.
        ready_timeout_s: How long `open` waits until the modem is configured.
        driver: Name of the modem's driver.

    Raises:
        ConfigError: An unsupported kind of URL, an unknown driver, or an address out of range.
    """

    def __init__(
        self, url: str, *, address: int, baud: int = 19200, ready_timeout_s: float = 30.0, driver: str = DEFAULT_DRIVER
    ) -> None:
        self._url = url
        self._ready_timeout_s = ready_timeout_s
        self._port = open_modem_port(url, baud)
        settings = ModemSettings(address, stream=self._port.STREAM)
        self._runner = ModemRunner(modem_driver(driver).create(settings, url), self._port, self._on_event)
        self._changed = threading.Condition()
        self._results: dict[int, PacketSent | PacketFailed] = {}
        self._received: deque[PacketReceived] = deque(maxlen=MAX_RECEIVED_PACKETS)
        self._is_open = False

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def is_ready(self) -> bool:
        """Whether the modem is configured and replies."""
        return self._runner.ready

    def open(self) -> None:
        """Open the port and configure the modem.

        Raises:
            PortError: The port cannot be opened, the modem does not reply, or both are open already.
        """
        self._runner.start()
        self._is_open = True
        with self._changed:
            self._changed.wait_for(lambda: self._runner.ready, self._ready_timeout_s)
        if not self._runner.ready:
            reason = self._port.error or ("no reply from the modem" if self._port.is_open else "not open")
            self.close()
            raise PortError(f"{self._url}: not ready within {self._ready_timeout_s} s: {reason}")

    def close(self) -> None:
        """Close the port. A `send` in another thread raises TransmissionError."""
        self._is_open = False
        self._runner.stop()
        with self._changed:
            self._changed.notify_all()

    def send(self, frames: Sequence[bytes], *, destination: int, rate: int, ack: bool = False) -> PacketSent:
        """Send one packet; return when it is transmitted.

        Args:
            frames: The frames, at most as many and as long as the rate allows.
            destination: Address of the receiving modem, or of all; 127 for all Micro-Modems.
            rate: Rate number; 0 to 6 for the Micro-Modem.
            ack: Request acoustic acknowledgements; the result has the numbers of the acknowledged frames.

        Raises:
            FrameError: An address, a rate or frames that the modem cannot send.
            PortError: The modem is not open.
            TransmissionError: The modem did not transmit the packet.
        """
        if not self._is_open:
            raise PortError(f"{self._url}: not open")
        packet_id = self._runner.send_packet(destination, rate, frames, ack=ack)
        with self._changed:
            self._changed.wait_for(lambda: packet_id in self._results or not self._is_open)
            result = self._results.pop(packet_id, None)
        if isinstance(result, PacketSent):
            return result
        reason = "the port is closed" if result is None else str(result.reason)
        raise TransmissionError(f"{self._url}: packet to {destination} not sent: {reason}")

    def receive(self, timeout_s: float | None = None) -> PacketReceived | None:
        """Return the next received packet, also one that was addressed to another modem.

        Args:
            timeout_s: How long to wait; None waits until a packet arrives.

        Returns:
            None when no packet arrives in time.
        """
        with self._changed:
            self._changed.wait_for(lambda: bool(self._received) or not self._is_open, timeout_s)
            return self._received.popleft() if self._received else None

    def _on_event(self, event: ModemEvent) -> None:
        with self._changed:
            if isinstance(event, (PacketSent, PacketFailed)):
                self._results[event.packet_id] = event
            elif isinstance(event, PacketReceived):
                self._received.append(event)
            self._changed.notify_all()
