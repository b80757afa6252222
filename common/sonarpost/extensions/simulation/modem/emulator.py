"""An emulated WHOI Micro-Modem as a pure state machine.

Bytes from the host and `now` (simulated seconds) go in, bytes for the host and packets for the channel come out. It
reads no clock and owns no port; `ChannelSimulator` connects several modems to one channel.

Choices where hardware documents are silent, and on which hosts should not rely:

- Data and acknowledgements for any destination are reported to the host (`promiscuous`), as the hosts' own filters
  suggest. Otherwise only packets for `SRC` or a broadcast address are. Only the addressed modem acknowledges,
  so a broadcast is never acknowledged. The flag of a frame's data requests acknowledgement, not that of the cycle
  command.
- A cycle whose host does not answer within `DTO` seconds is dropped: nothing is transmitted.
- A cycle without any data is still transmitted (header only), so that the host receives its `CATXF`.
- A command during a cycle is rejected as busy.
- During a reboot the modem ignores its host and receives nothing. A packet on the air is completed first.
- Every packet has `CATXP` and `CATXF` (0 bytes for acknowledgements and mini-packets), as hosts wait for the end of an
  automatic reply. `CAXST` is for data, cycle headers and flexible data.
- `CAREV` is sent after an idle period: hosts take it as the end of any exchange.
- An unfinished sentence is dropped 10 s after its last byte.
- An invalid or unknown sentence is answered with `CAERR,hhmmss,NMEA,number,text`.
"""

import math
import re
from collections import deque
from collections.abc import Callable
from datetime import datetime

from sonarpost.errors import SentenceError
from sonarpost.extensions.simulation.channel.events import AcousticPacket, ArrivalEnded, ArrivalStarted
from sonarpost.extensions.simulation.modem import commands
from sonarpost.extensions.simulation.modem.receiver import HostOutput, PacketReport, Receiver
from sonarpost.extensions.simulation.modem.settings import (
    FIRMWARE_VERSIONS,
    REBOOT_S,
    REVISION_PERIOD_S,
    EmulatedModemConfig,
    ModemClock,
    NvramSettings,
)
from sonarpost.extensions.simulation.modem.transmitter import BusyError, Transmitter, TransponderRanging, TravelTimes
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.micromodem.nmea import FieldReader, Sentence

_INPUT_PAUSE_S = 10.0  # longer than the longest sentence takes at 9600 bit/s
_ERROR_FRAMING, _ERROR_UNKNOWN, _ERROR_FIELD, _ERROR_BUSY = 1, 2, 3, 4
_UNPRINTABLE = re.compile(r"[^ -~]|[$*,]")


class EmulatedMicroModem:
    """One emulated modem, switched on at time zero: it sends `CAREV,…,INIT`.

    Args:
        config: Initial settings and timing.
        travel_times: One-way travel times to transponders; none by default.
    """

    def __init__(self, config: EmulatedModemConfig, travel_times: TravelTimes = dict) -> None:
        self.config = config
        self.settings = NvramSettings(config.address, config.data_timeout_s)
        self.clock = ModemClock(config.utc_at_zero_s)
        self._receiver = Receiver(config, self.settings, self.clock)
        self._transmitter = Transmitter(config, self.settings, self.clock, self._write, self._receiver.expect_data)
        self._ranging = TransponderRanging(self.settings, self.clock, self._transmitter, travel_times, self._write)
        self._lines = nmea.LineAssembler("host")
        self._pause_ends_s = math.inf
        self._outputs: deque[HostOutput] = deque()
        self._rebooted_at_s: float | None = None
        self._next_revision_s = 0.0
        self._handlers: dict[str, Callable[[Sentence, float], None]] = {
            "CCALQ": self._on_api_level_query,
            "CCCFG": self._on_configure,
            "CCCFQ": self._on_setting_query,
            "CCMSC": self._on_reboot,
            "CCCLK": self._on_set_clock,
            "CCCLQ": self._on_clock_query,
            "CCCYC": self._transmitter.start_cycle,
            "CCTXD": self._transmitter.fill_frame,
            "CCTXA": self._transmitter.fill_frame,
            "CCMPC": self._transmitter.send_mini,
            "CCMUC": self._transmitter.send_mini,
            "CCPDT": self._ranging.start,
            "CCPNT": self._ranging.start,
        }
        if config.generation > 1:
            self._handlers |= {
                "CCTMS": self._on_set_time,
                "CCTMQ": self._on_time_query,
                "CCTDP": self._transmitter.send_flexible,
            }
        self._send_revision("INIT", 0.0)

    @property
    def address(self) -> int:
        """The modem's current address (`SRC`)."""
        return self.settings["SRC"]

    @property
    def rebooting(self) -> bool:
        """Whether the modem is rebooting: it ignores its host and receives nothing."""
        return self._rebooted_at_s is not None

    @property
    def busy(self) -> bool:
        """Whether a cycle, a transmission, a reception or an interrogation of transponders is in progress."""
        return self._transmitter.busy or self._receiver.busy or self._ranging.busy

    def receive(self, data: bytes, now: float) -> None:
        """Process bytes from the host; invalid ones are answered with errors."""
        self._end_pause(now)
        self._pause_ends_s = now + _INPUT_PAUSE_S
        items = [] if self.rebooting else self._lines.feed(data)
        for item in items:
            if not self.rebooting:
                self._process(item, now)

    def poll(self, now: float) -> None:
        """Do what is due at `now`: end of a transmission, data timeout, automatic replies, revision, reboot."""
        self._end_pause(now)
        if self._rebooted_at_s is not None:
            if now < self._rebooted_at_s:
                return
            self._rebooted_at_s = None
            self._send_revision("INIT", now)
        was_busy = self.busy
        self._transmitter.poll(now)
        for line in self._receiver.poll(now):
            self._write(line)
        self._ranging.poll(now)
        if was_busy or self.busy:
            self._next_revision_s = max(self._next_revision_s, now + REVISION_PERIOD_S)
        elif self._next_revision_s <= now:
            self._send_revision("AUV", now)

    def next_deadline_s(self) -> float:
        """Return the simulated time at which `poll` has something to do."""
        if self._rebooted_at_s is not None:
            return self._rebooted_at_s
        times_s = (self._transmitter.next_deadline_s(), self._receiver.deadline_s, self._ranging.deadline_s)
        return min([self._next_revision_s, self._pause_ends_s, *(time_s for time_s in times_s if time_s is not None)])

    def arrival_started(self, arrival: ArrivalStarted) -> None:
        """Process the start of a packet at this modem."""
        if not self.rebooting:
            for line in self._receiver.arrival_started(arrival.transmission.packet):
                self._write(line)

    def arrival_ended(self, arrival: ArrivalEnded) -> PacketReport:
        """Process the end of a packet at this modem.

        Returns:
            The report for the host. Unless it has an `unreported_reason`, it is also attached to the last of its
            sentences.
        """
        if self.rebooting:
            return PacketReport(arrival, self.address, "rebooting")
        if self.busy:
            self._next_revision_s = max(self._next_revision_s, arrival.time_s + REVISION_PERIOD_S)
        host_report = self._receiver.arrival_ended(arrival)
        reason = host_report.unreported_reason
        if not host_report.lines:
            reason = reason or "statistics are off"
        report = PacketReport(arrival, self.address, reason)
        for line in host_report.lines:
            self._write(line)
        if reason is None:
            self._outputs[-1] = HostOutput(self._outputs[-1].data, report)
        if not host_report.missed:
            self._transmitter.reply(arrival, host_report.good_frames)
        return report

    def packets_to_transmit(self) -> list[AcousticPacket]:
        """Remove and return the packets whose transmission starts now."""
        return self._transmitter.packets_to_transmit()

    def take_outputs(self) -> list[HostOutput]:
        """Remove and return the output for the host, with the reports it completes."""
        outputs = list(self._outputs)
        self._outputs.clear()
        return outputs

    def bytes_to_send(self) -> bytes:
        """Remove and return the bytes for the host, without the reports."""
        return b"".join(output.data for output in self.take_outputs())

    def host_disconnected(self) -> None:
        """Drop an unfinished sentence of the host; cycle and settings stay."""
        self._lines.reset()

    def _end_pause(self, now: float) -> None:
        if now >= self._pause_ends_s:
            self._pause_ends_s = math.inf
            self._lines.reset()

    def _process(self, item: Sentence | SentenceError, now: float) -> None:
        if isinstance(item, SentenceError):
            self._send_error("NMEA", _ERROR_FRAMING, f"bad {item.field or 'sentence'}", now)
            return
        handler = self._handlers.get(item.kind)
        if handler is None:
            self._send_error("NMEA", _ERROR_UNKNOWN, f"unknown {item.kind}", now)
            return
        try:
            handler(item, now)
        except BusyError:
            self._send_error("CYCLE", _ERROR_BUSY, f"{item.kind} while busy", now)
        except SentenceError as error:
            self._send_error("NMEA", _ERROR_FIELD, f"{item.kind} bad {error.field}", now)

    def _write(self, line: bytes) -> None:
        self._outputs.append(HostOutput(line))

    def _send(self, kind: str, *fields: str | int) -> None:
        self._write(nmea.format(kind, *fields))

    def _send_error(self, module: str, number: int, text: str, now: float) -> None:
        self._send("CAERR", self.clock.hhmmss(now), module, number, _UNPRINTABLE.sub("?", text)[:60])

    def _send_revision(self, role: str, now: float) -> None:
        if role == "INIT" or self.settings.on("REV"):
            self._send("CAREV", self.clock.hhmmss(now), role, FIRMWARE_VERSIONS[self.config.generation])
        # The period starts at the due time, not at `now`, so that a late poll does not shift the following ones.
        missed = max(0, math.floor((now - self._next_revision_s) / REVISION_PERIOD_S))
        base_s = now if role == "INIT" else self._next_revision_s + missed * REVISION_PERIOD_S
        self._next_revision_s = base_s + REVISION_PERIOD_S

    def _on_configure(self, sentence: Sentence, _now: float) -> None:
        read = FieldReader(sentence, strict=True)
        name, value = read.text(0, "name"), read.integer(1, "value", -(2**31), 2**31 - 1)
        self.settings.store(name, value)
        self._send("CACFG", name, value)

    def _on_setting_query(self, sentence: Sentence, _now: float) -> None:
        name = FieldReader(sentence, strict=True).text(0, "name")
        everything = name.upper() in {"ALL", "TOP"}
        settings: list[tuple[str, str | int]] = [*(self.settings.items() if everything else self.settings.group(name))]
        version = "info.firmware_version"
        if self.config.generation > 1 and (everything or version == name or version.startswith(f"{name}.")):
            settings.append((version, FIRMWARE_VERSIONS[2]))
        for stored, value in settings or [self.settings.stored(name)]:
            self._send("CACFG", stored, value)

    def _on_reboot(self, sentence: Sentence, now: float) -> None:
        read = FieldReader(sentence, strict=True)
        read.address(0, "source")
        read.address(1, "destination")
        read.integer(2, "minutes", 0, 0)
        self._rebooted_at_s = max(now + REBOOT_S, self._transmitter.end_of_transmission_s(now))
        self._transmitter.reset()
        self._receiver.reset()
        self._ranging.reset()
        self._lines.reset()

    def _on_set_clock(self, sentence: Sentence, now: float) -> None:
        self._set_clock(commands.calendar_time(sentence), now)
        self._send("CACLK", *sentence.fields[:6])

    def _on_clock_query(self, _sentence: Sentence, now: float) -> None:
        self._send("CACLK", *self.clock.at(now).timetuple()[:6])

    def _on_set_time(self, sentence: Sentence, now: float) -> None:
        self._set_clock(commands.iso_time(sentence), now)
        self._send("CATMS", 0, self.clock.iso(now))

    def _on_time_query(self, _sentence: Sentence, now: float) -> None:
        self._send("CATMQ", self.clock.iso(now), self.clock.source, "RTC")

    def _on_api_level_query(self, _sentence: Sentence, _now: float) -> None:
        self._send("CAALQ", 0, 11 if self.config.generation > 1 else 6)

    def _set_clock(self, date: datetime, now: float) -> None:
        source = self.clock.source
        self.clock.set(date, now)
        if self.config.generation > 1 and self.clock.source != source:
            self._send("CATMG", self.clock.iso(now), self.clock.source, "RTC")
