"""The channel emulator: emulated modems on real ports, in real time.

One thread reads the clock, moves bytes between the ports and a `ChannelSimulator`, and writes the log. All decisions
are made in the simulator, which needs neither clock nor port.
"""

import logging
import math
import os
import select
import threading
import time
from collections import deque
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from typing import IO

from sonarpost.errors import PortError
from sonarpost.extensions.simulation.channel.config import EmulatorConfig
from sonarpost.extensions.simulation.channel.host_ports import PtyPort, TcpPort
from sonarpost.extensions.simulation.channel.packet_log import PacketLog, PacketTotals
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.receiver import HostOutput, PacketReport

log = logging.getLogger(__name__)

PORT_POLL_S = 0.02
MAX_WAIT_S = 0.5
MAX_READS_PER_STEP = 16
MAX_PENDING_BYTES = 1 << 20
"""Beyond this, a host that does not read loses whole sentences."""


@dataclass(frozen=True, slots=True)
class Device:
    """The device by which a host reaches a modem: a path or a pyserial URL."""

    modem: int
    address: int
    device: str


@dataclass(slots=True)
class _HostLine:
    """A port and its output that is not written yet."""

    port: PtyPort | TcpPort
    was_connected: bool = False
    pending: deque[HostOutput] = field(default_factory=deque)
    pending_bytes: int = 0
    written_of_first: int = 0


class ChannelEmulator:
    """Emulated modems on pseudo-terminals or TCP ports, with the channel between them.

    Its ports and its log are open from the beginning: hosts can connect, and get no answer before `start`.

    Args:
        config: Its configuration.
        echo: A second output for every line of the log.

    Raises:
        PortError: A port or the log cannot be opened; everything is closed again.
    """

    def __init__(self, config: EmulatorConfig, echo: IO[str] | None = None) -> None:
        self.config = config
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._lines: dict[int, _HostLine] = {}
        self._thread: threading.Thread | None = None
        self._simulator: ChannelSimulator
        self._started_s = 0.0  # reading of the monotonic clock at simulated time zero
        self._wake_out = self._wake_in = -1
        self.failure: Exception | None = None
        """The error that ended the emulator; None while it runs and after `stop`."""
        self._log = PacketLog(config.log, echo)
        try:
            for number in range(1, len(config.modem) + 1):
                self._lines[number] = _HostLine(self._open_port(number))
        except PortError:
            self._close()
            raise

    def start(self) -> None:
        """Start the thread, once."""
        self._simulator = self._make_simulator()
        self._started_s = time.monotonic()
        self._wake_out, self._wake_in = os.pipe()
        self._thread = threading.Thread(target=self._run, name="acoustic-channel", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop, write the totals and close everything; without effect if it is stopped already."""
        if self._stopping.is_set():
            return
        self._stopping.set()
        if self._thread is None:
            self._close()
            return
        os.write(self._wake_in, b"x")
        self._thread.join()
        os.close(self._wake_in)
        os.close(self._wake_out)

    def devices(self) -> list[Device]:
        """Return the device of every modem, by modem number."""
        modems = self.config.modem
        return [Device(number, modems[number - 1].address, line.port.device) for number, line in self._lines.items()]

    def totals(self) -> PacketTotals:
        """Return the counts of packets and frames so far."""
        with self._lock:
            return deepcopy(self._log.totals)

    def connected(self) -> int:
        """Return the number of modems with a connected host."""
        with self._lock:
            return sum(line.port.connected for line in self._lines.values())

    def _open_port(self, number: int) -> PtyPort | TcpPort:
        if self.config.tcp_ports:
            return TcpPort(self.config.tcp_host, self.config.tcp_ports[number - 1])
        return PtyPort(self.config.pty_dir / f"modem-{number}")

    def _make_simulator(self) -> ChannelSimulator:
        # Two seconds of real time at time scales above 1.
        data_timeout_s = math.ceil(max(2.0, 2.0 * self.config.time_scale))
        now_utc_s = time.time()
        modems = {
            number: PlacedModem(self.config.modem_config(modem, now_utc_s, data_timeout_s), modem.position)
            for number, modem in enumerate(self.config.modem, start=1)
        }
        transponders = {str(site.letter): site.position for site in self.config.transponder}
        return ChannelSimulator(self.config.parameters, modems, self.config.serial_baud or None, transponders)

    def _settings(self) -> dict[str, object]:
        modems = [
            {"modem": device.modem, "address": device.address, "device": device.device, "position_m": asdict(position)}
            for device, position in zip(self.devices(), (modem.position for modem in self.config.modem), strict=True)
        ]
        return {
            "time_scale": self.config.time_scale,
            "serial_baud": self.config.serial_baud or None,
            "water": self.config.parameters.model_dump(mode="json"),
            "modems": modems,
        }

    def _run(self) -> None:
        failure: Exception | None = None
        try:
            self._write("start", **self._settings())
            while not self._stopping.is_set():
                with self._lock:
                    self._step()
                    poll = self._poll_set()
                    timeout_s = self._timeout_s()
                # Rounded up: waking a moment late has no effect, waking early would spin.
                poll.poll(math.ceil(timeout_s * 1000))
            with self._lock:
                self._finish()
        except Exception as error:
            failure = error
            log.exception("Channel emulator failed")
        finally:
            self._close()
            # Set last: the ports are closed once a failure is visible.
            self.failure = failure

    def _now_s(self) -> float:
        return (time.monotonic() - self._started_s) * self.config.time_scale

    def _step(self) -> None:
        for number, line in self._lines.items():
            self._read(number, line)
            line.port.update_connection()
            self._note_connection(number, line)
        for happened in self._simulator.advance(self._now_s()):
            if isinstance(happened, PacketReport):
                self._log.packet(happened, happened.unreported_reason, time.time())
            else:
                self._log.totals.transmitted += 1
        for number, line in self._lines.items():
            for output in self._simulator.take_outputs(number):
                self._queue(line, output)
            self._flush(line)
            self._note_connection(number, line)

    def _read(self, number: int, line: _HostLine) -> None:
        for _ in range(MAX_READS_PER_STEP):
            data = line.port.read()
            if not data:
                return
            self._simulator.receive(number, data, self._now_s())

    def _note_connection(self, number: int, line: _HostLine) -> None:
        if line.port.connected == line.was_connected:
            return
        line.was_connected = line.port.connected
        self._write("client", modem=number, connected=line.port.connected)
        if not line.port.connected:
            self._simulator.host_disconnected(number)
            self._drop_pending(line, "client left")

    def _queue(self, line: _HostLine, output: HostOutput) -> None:
        if not line.port.connected:
            self._log_unreported(output, "no client connected")
        elif line.pending_bytes + len(output.data) > MAX_PENDING_BYTES:
            self._log_unreported(output, "client does not read")
        else:
            line.pending.append(output)
            line.pending_bytes += len(output.data)

    def _flush(self, line: _HostLine) -> None:
        while line.pending and line.port.connected:
            first = line.pending[0]
            rest = first.data[line.written_of_first :]
            # An output without bytes is complete: a port writes none of them, as one that cannot write now.
            count = line.port.write(rest) if rest else 0
            if rest and not count:
                return
            line.written_of_first += count
            line.pending_bytes -= count
            if count == len(rest):
                line.pending.popleft()
                line.written_of_first = 0
                if first.report is not None:
                    self._log.packet(first.report, None, time.time())

    def _drop_pending(self, line: _HostLine, reason: str) -> None:
        while line.pending:
            self._log_unreported(line.pending.popleft(), reason)
        line.pending_bytes = line.written_of_first = 0

    def _log_unreported(self, output: HostOutput, reason: str) -> None:
        if output.report is not None:
            self._log.packet(output.report, reason, time.time())

    def _poll_set(self) -> select.poll:
        poll = select.poll()
        poll.register(self._wake_out, select.POLLIN)
        for line in self._lines.values():
            for descriptor, mask in line.port.poll_masks(writing=bool(line.pending)):
                poll.register(descriptor, mask)
        return poll

    def _timeout_s(self) -> float:
        poll_ports = any(line.port.needs_polling for line in self._lines.values())
        due_s = (self._simulator.next_deadline_s() - self._now_s()) / self.config.time_scale
        return min(max(0.0, due_s), PORT_POLL_S if poll_ports else MAX_WAIT_S)

    def _finish(self) -> None:
        for line in self._lines.values():
            self._drop_pending(line, "emulator stopped")
        for number in self._lines:
            for output in self._simulator.discard_outputs(number):
                self._log_unreported(output, "emulator stopped")
        self._write("stop")
        totals = self._log.totals
        self._write(
            "totals",
            transmitted=totals.transmitted,
            heard=totals.reported,
            not_heard=totals.unreported,
            frames=totals.frames,
            in_flight=self._simulator.channel.in_flight,
        )

    def _write(self, event: str, **fields: object) -> None:
        self._log.write(event, self._now_s(), time.time(), **fields)

    def _close(self) -> None:
        for line in self._lines.values():
            line.port.close()
        self._log.close()
