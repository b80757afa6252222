"""The emulated modems and their water as a running thing: ports, one thread, a clock and a log.

The thread does what `ChannelSimulator` cannot: it reads the clock, moves bytes between ports and world, and writes down
what became of each packet. Everything else is decided in the pure parts.
"""

from __future__ import annotations

import logging
import math
import os
import select
import threading
import time
from collections import deque
from dataclasses import asdict, dataclass, field, replace
from enum import Enum
from typing import IO

from sonarpost.errors import PortError
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.channel_log import PacketLog, Totals
from sonarpost.simulation.channel.channel_simulator import ChannelSimulator, PlacedModem
from sonarpost.simulation.channel.emulator_config import Device, EmulatorConfig
from sonarpost.simulation.modem.config import HostOutput, PacketReport
from sonarpost.simulation.modem.host_ports import HostPort, PtyPort, TcpPort
from sonarpost.simulation.time_scale import TimeScale

log = logging.getLogger(__name__)

ASK_PORTS_S = 0.02
READS_A_STEP = 16
LONGEST_WAIT_S = 0.5
MOST_WAITING_BYTES = 1 << 20
"""A host that does not read loses whole sentences beyond this."""


@dataclass(slots=True)
class _Line:
    """A port and what waits to be written to it."""

    port: HostPort
    was_connected: bool = False
    waiting: deque[HostOutput] = field(default_factory=deque)
    waiting_bytes: int = 0
    written_of_first: int = 0


class _State(Enum):
    NEW = "new"
    OPEN = "open"
    RUNNING = "running"
    CLOSED = "closed"


class ChannelEmulator:
    """Emulated modems on real ports.

    Args:
        config: What it is made of.
        echo: A second place for every line of the log.
    """

    def __init__(self, config: EmulatorConfig, echo: IO[str] | None = None) -> None:
        self.config = config
        self._echo = echo
        self._lock = threading.Lock()
        self._state = _State.NEW
        self._stopping = threading.Event()
        self._lines: dict[int, _Line] = {}
        self._log = PacketLog(None)
        self._thread: threading.Thread
        self._world: ChannelSimulator
        self._clock: TimeScale
        self._wake_out = self._wake_in = -1
        self.failure: Exception | None = None
        """Why the channel ended by itself; None while it runs or when it was stopped."""

    def open(self) -> None:
        """Open the ports and the log: hosts can connect, and nothing is answered yet.

        Raises:
            PortError: A port or the log cannot be opened; nothing is left open then.
            RuntimeError: It was opened before.
        """
        if self._state is not _State.NEW:
            raise RuntimeError("an ChannelEmulator is opened once")
        self._state = _State.OPEN
        try:
            self._log = PacketLog(self.config.log_path, self._echo)
            for number in range(1, len(self.config.sites) + 1):
                self._lines[number] = _Line(self._open_port(number))
        except PortError:
            self._state = _State.CLOSED
            self._close()
            raise

    def start(self) -> None:
        """Begin, after `open` where that was not called.

        Raises:
            PortError: A port or the log cannot be opened.
            RuntimeError: It was started before.
        """
        if self._state is not _State.OPEN:
            self.open()
        self._state = _State.RUNNING
        self._world = self._make_world()
        self._clock = TimeScale(self.config.time_scale, time.monotonic())
        self._wake_out, self._wake_in = os.pipe()
        self._thread = threading.Thread(target=self._run, name="acoustic-channel", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, write the totals and close everything; a channel that is not open is left alone."""
        state, self._state = self._state, _State.CLOSED
        if state is _State.OPEN:
            self._close()
        elif state is _State.RUNNING:
            self._stopping.set()
            os.write(self._wake_in, b"x")
            self._thread.join()
            os.close(self._wake_in)
            os.close(self._wake_out)

    def devices(self) -> list[Device]:
        """Return what hosts open, by number of the modem."""
        sites = self.config.sites
        return [Device(number, sites[number - 1].address, line.port.device) for number, line in self._lines.items()]

    def totals(self) -> Totals:
        """Return the counts of packets and frames so far."""
        with self._lock:
            return self._log.totals()

    def connected(self) -> int:
        """Return how many modems have a client."""
        with self._lock:
            return sum(line.port.connected for line in self._lines.values())

    def move(self, modem: int, position: LocalPosition) -> None:
        """Put a modem elsewhere.

        Raises:
            KeyError: No modem of that number.
        """
        with self._lock:
            self._world.water.move(modem, position)
            self._write("move", modem=modem, position_m=asdict(position))

    # Building

    def _open_port(self, number: int) -> HostPort:
        if self.config.pty_dir is not None:
            return PtyPort(self.config.pty_dir / f"modem-{number}")
        return TcpPort(self.config.tcp_host, self.config.tcp_ports[number - 1])

    def _make_world(self) -> ChannelSimulator:
        timeout_s = math.ceil(max(2.0, 2.0 * self.config.time_scale))
        template = replace(self.config.modem, utc_at_zero_s=time.time(), data_timeout_s=timeout_s)
        places = {
            number: PlacedModem(replace(template, address=site.address), site.position)
            for number, site in enumerate(self.config.sites, start=1)
        }
        return ChannelSimulator(self.config.water, places, self.config.serial_baud, self.config.transponders)

    def _settings(self) -> dict[str, object]:
        water = asdict(self.config.water) | {"tail_damage_kind": self.config.water.tail_damage_kind.value}
        modems = [
            {"modem": device.modem, "address": device.address, "device": device.device, "position_m": asdict(position)}
            for device, position in zip(self.devices(), (site.position for site in self.config.sites), strict=True)
        ]
        baud = self.config.serial_baud
        return {"time_scale": self.config.time_scale, "serial_baud": baud, "water": water, "modems": modems}

    # The thread

    def _run(self) -> None:
        failure: Exception | None = None
        try:
            self._write("start", **self._settings())
            while not self._stopping.is_set():
                with self._lock:
                    self._step()
                    waiting = self._poll_set()
                    timeout_s = self._timeout_s()
                # Rounded up: waking a moment late costs nothing, waking early would spin.
                waiting.poll(math.ceil(timeout_s * 1000))
            with self._lock:
                self._finish()
        except Exception as error:
            failure = error
            log.exception("Acoustic channel failed")
        finally:
            self._close()
            # Told last: who sees it may count on closed ports.
            self.failure = failure

    def _now_s(self) -> float:
        return self._clock.simulated_s(time.monotonic())

    def _step(self) -> None:
        for number, line in self._lines.items():
            self._read(number, line)
            line.port.notice()
            self._note_client(number, line)
        for happened in self._world.advance(self._now_s()):
            if isinstance(happened, PacketReport):
                self._log.packet(happened, happened.untold, time.time())
            else:
                self._log.transmitted += 1
        for number, line in self._lines.items():
            for output in self._world.take_outputs(number):
                self._put(line, output)
            self._flush(line)
            self._note_client(number, line)

    def _read(self, number: int, line: _Line) -> None:
        for _ in range(READS_A_STEP):
            data = line.port.read()
            if not data:
                return
            self._world.receive(number, data, self._now_s())

    def _note_client(self, number: int, line: _Line) -> None:
        if line.port.connected == line.was_connected:
            return
        line.was_connected = line.port.connected
        self._write("client", modem=number, connected=line.port.connected)
        if not line.port.connected:
            self._world.forget_host(number)
            self._drop(line, "client left")

    def _put(self, line: _Line, output: HostOutput) -> None:
        if not line.port.connected:
            self._untold(output, "no client connected")
        elif line.waiting_bytes + len(output.data) > MOST_WAITING_BYTES:
            self._untold(output, "client does not read")
        else:
            line.waiting.append(output)
            line.waiting_bytes += len(output.data)

    def _flush(self, line: _Line) -> None:
        while line.waiting and line.port.connected:
            first = line.waiting[0]
            count = line.port.write(first.data[line.written_of_first :])
            if not count:
                return
            line.written_of_first += count
            line.waiting_bytes -= count
            if line.written_of_first == len(first.data):
                line.waiting.popleft()
                line.written_of_first = 0
                if first.report is not None:
                    self._log.packet(first.report, None, time.time())

    def _drop(self, line: _Line, reason: str) -> None:
        while line.waiting:
            self._untold(line.waiting.popleft(), reason)
        line.waiting_bytes = line.written_of_first = 0

    def _untold(self, output: HostOutput, reason: str) -> None:
        if output.report is not None:
            self._log.packet(output.report, reason, time.time())

    def _poll_set(self) -> select.poll:
        waiting = select.poll()
        waiting.register(self._wake_out, select.POLLIN)
        for line in self._lines.values():
            for descriptor, mask in line.port.interests(writing=bool(line.waiting)):
                waiting.register(descriptor, mask)
        return waiting

    def _timeout_s(self) -> float:
        asked = any(line.port.must_be_asked for line in self._lines.values())
        due_s = self._clock.wait_s(self._world.next_deadline_s(), time.monotonic())
        return min(due_s, ASK_PORTS_S if asked else LONGEST_WAIT_S)

    def _finish(self) -> None:
        for line in self._lines.values():
            self._drop(line, "emulator stopped")
        for number in self._lines:
            for output in self._world.abandon_outputs(number):
                self._untold(output, "emulator stopped")
        self._write("stop")
        self._write("totals", **asdict(self._log.totals()), in_flight=self._world.water.in_flight)

    def _write(self, event: str, **fields: object) -> None:
        self._log.write(event, self._now_s(), time.time(), **fields)

    def _close(self) -> None:
        for line in self._lines.values():
            line.port.close()
        self._log.close()
