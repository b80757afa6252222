"""An emulated WHOI Micro-Modem as a pure state machine.

Bytes from the host and `now` (simulated seconds) in, bytes for the host and packets for the water out. It reads no
clock and owns no port; `sonarpost.simulation.channel.channel_simulator` joins several of them to one water.

Choices where hardware documents are silent, and where hosts should not lean on more:

- Data, acknowledgements included, is shown to the host whatever its destination (`promiscuous`), as the hosts' own
  filters suggest the hardware does; switched off, only packets for `SRC` or a broadcast address are.
  Only the addressed modem acknowledges, so a broadcast is never acknowledged. What asks for an acknowledgement is the
  flag that came with a frame's data, not the one of the cycle command.
- A cycle whose host does not answer within `DTO` seconds is abandoned: nothing is sent.
- A cycle without any data is still transmitted (header only), so that a host never waits in vain for `CATXF`.
- A command during a cycle is refused as busy.
- While rebooting, the modem takes nothing from the host and hears nothing; a packet on the air is finished first.
- Every packet has `CATXP` and `CATXF` (0 bytes for acknowledgements and mini-packets), as hosts wait for the end of an
  automatic answer; `CAXST` is for data, cycle headers and flexible data.
- `CAREV` comes when nothing has happened for its period: a host takes it as the end of whatever it was doing.
- A sentence that does not parse, or that no modem knows, is answered with `CAERR,hhmmss,NMEA,number,text`.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from datetime import datetime

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem import nmea
from sonarpost.simulation.channel.channel_events import AcousticPacket, ArrivalEnded, ArrivalStarted
from sonarpost.simulation.modem import commands
from sonarpost.simulation.modem.config import VERSIONS, EmulatedModemConfig, HostOutput, PacketReport
from sonarpost.simulation.modem.navigation import TransponderRanging, TravelTimes
from sonarpost.simulation.modem.reception import Receiver
from sonarpost.simulation.modem.settings import ModemClock, ModemSettings
from sonarpost.simulation.modem.transmitter import BusyError, Transmitter

_ERROR_FRAMING, _ERROR_UNKNOWN, _ERROR_FIELD, _ERROR_BUSY = 1, 2, 3, 4
_UNPRINTABLE = re.compile(r"[^ -~]|[$*,]")


class EmulatedMicroModem:
    """One emulated modem.

    Args:
        config: How it is built.
        now: Simulated time at which it is switched on; it says `CAREV,…,INIT`.
        travel_times: One-way travel times to transponders; none by default.
    """

    def __init__(self, config: EmulatedModemConfig, now: float = 0.0, travel_times: TravelTimes = dict) -> None:
        self.config = config
        self.settings = ModemSettings(config.address, config.data_timeout_s)
        self.clock = ModemClock(config.utc_at_zero_s)
        self._listener = Receiver(config, self.settings, self.clock)
        self._transmitter = Transmitter(config, self.settings, self.clock, self._write, self._listener.expect)
        self._navigator = TransponderRanging(self.settings, self.clock, self._transmitter, travel_times, self._write)
        self._lines = nmea.LineAssembler("host")
        self._outputs: deque[HostOutput] = deque()
        self._rebooted_at_s: float | None = None
        self._next_revision_s = now
        self._handlers = self._first_generation()
        if config.generation > 1:
            self._handlers |= self._second_generation()
        self._say_revision("INIT", now)

    def _first_generation(self) -> dict[str, Callable[[nmea.Sentence, float], None]]:
        return {
            "CCALQ": self._on_ask_level,
            "CCCFG": self._on_configure,
            "CCCFQ": self._on_query,
            "CCMSC": self._on_sleep,
            "CCCLK": self._on_set_clock,
            "CCCLQ": self._on_ask_clock,
            "CCCYC": self._transmitter.start_cycle,
            "CCTXD": self._transmitter.fill_frame,
            "CCTXA": self._transmitter.fill_frame,
            "CCMPC": self._transmitter.send_mini,
            "CCMUC": self._transmitter.send_mini,
            "CCPDT": self._navigator.start,
            "CCPNT": self._navigator.start,
        }

    def _second_generation(self) -> dict[str, Callable[[nmea.Sentence, float], None]]:
        return {
            "CCTMS": self._on_set_time,
            "CCTMQ": self._on_ask_time,
            "CCTDP": self._transmitter.send_flexible,
        }

    @property
    def address(self) -> int:
        """The modem's present address (`SRC`)."""
        return self.settings["SRC"]

    @property
    def rebooting(self) -> bool:
        """Whether the modem is deaf and dumb for the time being."""
        return self._rebooted_at_s is not None

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host. Whatever they are, nothing is raised."""
        items = [] if self.rebooting else self._lines.feed(data)
        for item in items:
            if not self.rebooting:
                self._take(item, now)

    @property
    def busy(self) -> bool:
        """Whether a cycle, a transmission, a reception or a ranging is not over."""
        return self._transmitter.busy or self._listener.busy or self._navigator.busy

    def poll(self, now: float) -> None:
        """Do what is due at `now`: end of a transmission, data timeout, automatic answers, revision, reboot."""
        if self._rebooted_at_s is not None:
            if now < self._rebooted_at_s:
                return
            self._rebooted_at_s = None
            self._say_revision("INIT", now)
        was_busy = self.busy
        self._transmitter.poll(now)
        for line in self._listener.poll(now):
            self._write(line)
        self._navigator.poll(now)
        if was_busy or self.busy:
            self._next_revision_s = max(self._next_revision_s, now + self.config.revision_period_s)
        elif self._next_revision_s <= now:
            self._say_revision("AUV", now)

    def next_deadline_s(self) -> float:
        """Return the simulated time at which `poll` has something to do."""
        if self._rebooted_at_s is not None:
            return self._rebooted_at_s
        times_s = (self._transmitter.next_deadline_s(), self._listener.deadline_s, self._navigator.deadline_s)
        return min([self._next_revision_s, *(time_s for time_s in times_s if time_s is not None)])

    def packet_started(self, arrival: ArrivalStarted) -> None:
        """The water says that a packet begins to arrive."""
        if not self.rebooting:
            for line in self._listener.begin(arrival.transmission.packet):
                self._write(line)

    def packet_ended(self, arrival: ArrivalEnded) -> PacketReport:
        """The water says that a packet has passed; return what the host learns of it.

        When `untold` of the report is None, the report is also attached to the last of the lines that tell it.
        """
        if self.rebooting:
            return PacketReport(arrival, self.address, "rebooting")
        if self.busy:
            self._next_revision_s = max(self._next_revision_s, arrival.at_s + self.config.revision_period_s)
        hearing = self._listener.hear(arrival)
        untold = hearing.untold if hearing.lines else (hearing.untold or "statistics are off")
        report = PacketReport(arrival, self.address, untold)
        last = len(hearing.lines) - 1
        for index, line in enumerate(hearing.lines):
            self._outputs.append(HostOutput(line, report if index == last and untold is None else None))
        if not hearing.missed:
            self._transmitter.answer(arrival, hearing.good_frames)
        return report

    def packets_to_transmit(self) -> list[AcousticPacket]:
        """Return, once, the packets that go into the water now."""
        return self._transmitter.packets_to_transmit()

    def take_outputs(self) -> list[HostOutput]:
        """Return, once, what is to be written to the host, with the reports it completes."""
        outputs = list(self._outputs)
        self._outputs.clear()
        return outputs

    def bytes_to_send(self) -> bytes:
        """Return, once, the bytes for the host, when nobody keeps the reports."""
        return b"".join(output.data for output in self.take_outputs())

    def forget_host(self) -> None:
        """The host went away: an unfinished sentence of its is dropped; cycle and settings stay."""
        self._lines.reset()

    def _take(self, item: nmea.Sentence | SentenceError, now: float) -> None:
        if isinstance(item, SentenceError):
            self._complain("NMEA", _ERROR_FRAMING, f"bad {item.field or 'sentence'}", now)
            return
        handler = self._handlers.get(item.kind)
        if handler is None:
            self._complain("NMEA", _ERROR_UNKNOWN, f"unknown {item.kind}", now)
            return
        try:
            handler(item, now)
        except BusyError:
            self._complain("CYCLE", _ERROR_BUSY, f"{item.kind} while busy", now)
        except SentenceError as error:
            self._complain("NMEA", _ERROR_FIELD, f"{item.kind} bad {error.field}", now)

    def _write(self, line: bytes) -> None:
        self._outputs.append(HostOutput(line))

    def _say(self, kind: str, *fields: str | int) -> None:
        self._write(nmea.format(kind, *fields))

    def _complain(self, module: str, number: int, text: str, now: float) -> None:
        self._say("CAERR", self.clock.hhmmss(now), module, number, _UNPRINTABLE.sub("?", text)[:60])

    def _say_revision(self, kind: str, now: float) -> None:
        if kind == "INIT" or self.settings.on("REV"):
            self._say("CAREV", self.clock.hhmmss(now), kind, VERSIONS[self.config.generation])
        # Counted from the last one due, not from now, so that a late poll does not shift the rest.
        period_s = self.config.revision_period_s
        behind = max(0, math.floor((now - self._next_revision_s) / period_s))
        base_s = now if kind == "INIT" else self._next_revision_s + behind * period_s
        self._next_revision_s = base_s + period_s

    def _on_configure(self, sentence: nmea.Sentence, _now: float) -> None:
        name = commands.field(sentence, 0, "name")
        value = commands.integer(sentence, 1, "value", -(2**31), 2**31 - 1)
        self.settings.store(name, value)
        self._say("CACFG", name, value)

    def _on_query(self, sentence: nmea.Sentence, _now: float) -> None:
        name = commands.field(sentence, 0, "name")
        everything = name.upper() in {"ALL", "TOP"}
        known = self.settings.items() if everything else self.settings.group(name)
        texts = [(stored, str(value)) for stored, value in known]
        if self.config.generation > 1:
            version = ("info.firmware_version", VERSIONS[2])
            texts += [version] if everything or version[0] == name or version[0].startswith(f"{name}.") else []
        if not texts:
            stored, number = self.settings.query(name)
            texts = [(stored, str(number))]
        for stored, value in texts:
            self._say("CACFG", stored, value)

    def _on_sleep(self, sentence: nmea.Sentence, now: float) -> None:
        for index, name in enumerate(("source", "destination")):
            commands.integer(sentence, index, name, 0, commands.MOST_ADDRESS)
        commands.integer(sentence, 2, "minutes", 0, 0)
        self._rebooted_at_s = max(now + self.config.reboot_s, self._transmitter.quiet_at_s(now))
        self._transmitter.abandon()
        self._listener.forget()
        self._navigator.forget()
        self._lines.reset()

    def _on_set_clock(self, sentence: nmea.Sentence, now: float) -> None:
        self._set_clock(commands.calendar_fields(sentence), now)
        self._say("CACLK", *sentence.fields[:6])

    def _on_ask_clock(self, _sentence: nmea.Sentence, now: float) -> None:
        date = self.clock.at(now)
        self._say("CACLK", date.year, date.month, date.day, date.hour, date.minute, date.second)

    def _on_set_time(self, sentence: nmea.Sentence, now: float) -> None:
        self._set_clock(commands.iso_time(sentence), now)
        self._say("CATMS", 0, self.clock.iso(now))

    def _on_ask_time(self, _sentence: nmea.Sentence, now: float) -> None:
        self._say("CATMQ", self.clock.iso(now), self.clock.source, "RTC")

    def _on_ask_level(self, _sentence: nmea.Sentence, _now: float) -> None:
        self._say("CAALQ", 0, 11 if self.config.generation > 1 else 6)

    def _set_clock(self, date: datetime, now: float) -> None:
        source = self.clock.source
        self.clock.set(date, now)
        if self.config.generation > 1 and self.clock.source != source:
            self._say("CATMG", self.clock.iso(now), self.clock.source, "RTC")
