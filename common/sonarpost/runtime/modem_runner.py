"""Thread that connects the sans-I/O modem driver with its port and a clock."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

from sonarpost.errors import PortError
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.modem.interface import Modem, ModemCapabilities, ModemEvent, PollHandler
from sonarpost.runtime.serial_port import ModemPort, PortEvent, PortLost, PortOpened

log = logging.getLogger(__name__)

_STOP_S = 1.0
_RETRY_S = 1.0
_POLL_S = 0.2
_MAX_WAIT_S = 0.25
"""Maximum time between two polls of the timers."""
MAX_INPUTS: Final = limit(
    256, "inputs", "claims", "modem port", "modem or network", "received parts waiting", "the port is not read further"
)


class ModemRunner:
    """Passes received bytes to the driver, polls its timers and writes its output to the port.

    Args:
        driver: The driver; used only by this runner from now on.
        port: The port, not started.
        on_event: Called with each event, in order, in the runner's thread and without a lock, so it may call
            `send_packet`. An exception from it is logged and loses that event only.

    Attributes:
        failures: Number of inputs after which the driver raised an unexpected exception. They are skipped.
        failure: The exception of the last input; empty if it was processed.
    """

    def __init__(
        self,
        driver: Modem,
        port: ModemPort,
        on_event: Callable[[ModemEvent], None],
    ) -> None:
        self._driver = driver
        self._port = port
        self._on_event = on_event
        self._lock = threading.Lock()
        self._inputs: queue.Queue[PortEvent | None] = queue.Queue(MAX_INPUTS)
        self.failures = 0
        self.failure = ""
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def capabilities(self) -> ModemCapabilities:
        """What the driver and its modem can do."""
        return self._driver.capabilities

    @property
    def ready(self) -> bool:
        """Whether the modem is configured and answers."""
        with self._lock:
            return self._driver.ready

    @property
    def queued(self) -> int:
        """Number of packets that wait or are being transmitted."""
        with self._lock:
            return self._driver.queued

    @property
    def receiving(self) -> bool:
        """Whether a packet is being received."""
        with self._lock:
            return self._driver.receiving

    def start(self) -> None:
        """Start the thread and open the port; returns at once.

        Raises:
            PortError: Already started.
        """
        if self._thread is not None:
            raise PortError(f"{self._port.url}: the runner is already started")
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name=f"modem {self._port.url}", daemon=True)
        self._thread.start()
        self._port.start(self._put)

    def stop(self) -> None:
        """Close the port and end the thread.

        A packet that is being transmitted is reported as failed before this returns. Packets that wait are sent after
        the next `start`.
        """
        self._port.close()
        self._stopping.set()
        self._wake()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join(_STOP_S)

    def send_packet(self, destination: int, rate: int, frames: Sequence[bytes], *, ack: bool = False) -> int:
        """Queue a packet, from any thread; see `Modem.send_packet`.

        Raises:
            FrameError: An address, a rate or frames that the modem cannot send.
        """
        return self.request(lambda driver, now: driver.send_packet(destination, rate, frames, ack=ack, now=now))

    def request_packet(self, source: int, rate: int, frames: int | None = None, *, ack: bool = False) -> int:
        """Queue a poll of another modem, from any thread; see `Modem.request_packet`.

        Raises:
            FrameError: An address, a rate or a number of frames that the modem cannot request.
        """
        return self.request(lambda driver, now: driver.request_packet(source, rate, frames, ack=ack, now=now))

    def set_poll_handler(self, uplink: PollHandler | None) -> None:
        """Set the function that returns frames when another modem polls; see `Modem.set_poll_handler`.

        It is called in the runner's thread. It must not block or call the runner.
        """
        with self._lock:
            self._driver.set_poll_handler(uplink)

    def request(self, request: Callable[[Modem, float], int]) -> int:
        """Call any other request of the driver, from any thread: `runner.request(lambda d, now: d.ping(2, now))`.

        Args:
            request: Receives the driver and the monotonic time, and returns the number of the request.
        """
        with self._lock:
            number = request(self._driver, time.monotonic())
        self._wake()
        return number

    def _put(self, event: PortEvent) -> None:
        while not self._stopping.is_set():
            with suppress(queue.Full):
                self._inputs.put(event, timeout=_POLL_S)
                return

    def _wake(self) -> None:
        with suppress(queue.Full):  # the thread is awake
            self._inputs.put_nowait(None)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._step(self._wait())
                self.failure = ""
            except Exception as error:
                self.failures += 1
                self.failure = f"the driver failed: {type(error).__name__}: {error}"
                log.exception("Modem driver failed; skipping its input", extra=kv(port=self._port.url))
                self._stopping.wait(_RETRY_S)
        with self._lock:
            self._driver.port_lost(time.monotonic())
            events = self._driver.poll(time.monotonic())
        self._deliver(events)

    def _wait(self) -> PortEvent | None:
        with self._lock:
            wakeup_s = self._driver.next_wakeup()
        wait_s = _MAX_WAIT_S
        if wakeup_s is not None:
            wait_s = min(max(0.0, wakeup_s - time.monotonic()), wait_s)
        try:
            return self._inputs.get(timeout=wait_s)
        except queue.Empty:
            return None

    def _step(self, item: PortEvent | None) -> None:
        with self._lock:
            now = time.monotonic()
            events = self._apply(item, now)
            events += self._driver.poll(now)
            parts = list(iter(self._driver.bytes_to_send, b""))
        for data in parts:
            self._write(data)
        self._deliver(events)

    def _apply(self, item: PortEvent | None, now: float) -> list[ModemEvent]:
        if isinstance(item, bytes):
            return self._driver.receive(item, now)
        if isinstance(item, PortOpened):
            self._driver.port_opened(now)
        elif isinstance(item, PortLost):
            self._driver.port_lost(now)
        return []

    def _write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except PortError as error:
            # The port reports the loss as an event, and the driver's time-outs cover the data that was not written.
            log.debug("Write failed", extra=kv(error=str(error)))

    def _deliver(self, events: list[ModemEvent]) -> None:
        for event in events:
            try:
                self._on_event(event)
            except Exception:
                log.exception("Modem event not handled", extra=kv(port=self._port.url, event=type(event).__name__))
