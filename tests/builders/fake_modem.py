"""A scripted modem for tests of the driver, independent of the emulator; it drops selected sentences."""

import heapq
from collections import Counter
from collections.abc import Callable
from itertools import count

from sonarpost.modem.interface import FrameDecoded, ModemEvent, TransmissionEnded, TransmissionStarted
from sonarpost.modem.micromodem import RATES, MicroModem, nmea
from sonarpost.modem.micromodem.sentences import Cycle

DropRule = Callable[[nmea.Sentence, int], bool]


def drop_nothing(sentence: nmea.Sentence, nth: int) -> bool:
    """Drop nothing."""
    return False


def drop_nth(kind: str, nth: int) -> DropRule:
    """Drop the nth (from 1) sentence of a kind."""
    return lambda sentence, seen: sentence.kind == kind and seen == nth


class FakeModem:
    """The modem and the simulated clock; `run` exchanges sentences with the driver until a given time.

    `TXP`, `TXF` and `XST` switch the sentences on a transmission. The modem echoes a command for one of the
    `fixed_settings` and does not store it. With `refuses_cycles` it answers every cycle command with `CAERR`.

    Args:
        driver: The driver under test.
        drops: Returns whether a sentence is lost, in either direction. Arguments: the sentence, and the number of its
            kind sent so far (from 1).
    """

    data_timeout_s = 4.0
    restart_s = 1.0

    def __init__(self, driver: MicroModem, drops: DropRule = drop_nothing) -> None:
        self.driver = driver
        self.drops = drops
        self.now = 0.0
        self.settings = {"SRC": "0", "CST": "0", "RXP": "0", "TXP": "0", "TXF": "0", "XST": "0"}
        self.fixed_settings: set[str] = set()
        self.refuses_cycles = False
        self.restarts = 0
        self.events: list[ModemEvent] = []
        self.frames_decoded: list[FrameDecoded] = []
        self.marks: list[TransmissionStarted | TransmissionEnded] = []
        self.received: list[nmea.Sentence] = []
        self.transmitted: list[tuple[bytes, ...]] = []
        self.unresponsive = False
        self.silent_kinds: set[str] = set()
        self.echo_settings = True
        self._cycle: Cycle | None = None
        self._frames: list[bytes] = []
        self._cycle_number = 0
        self.sentence_counts: Counter[str] = Counter()
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._lines = nmea.LineAssembler("host")

    def send(self, kind: str, *fields: str | int) -> None:
        """Send a sentence to the driver now."""
        sentence = nmea.Sentence(kind, tuple(str(f) for f in fields))
        self.sentence_counts[kind] += 1
        if (
            not self.unresponsive
            and kind not in self.silent_kinds
            and not self.drops(sentence, self.sentence_counts[kind])
        ):
            self._store(self.driver.receive(sentence.encode(), self.now))

    def send_bytes(self, data: bytes) -> None:
        """Send bytes to the driver now."""
        self._store(self.driver.receive(data, self.now))

    def _store(self, events: list[ModemEvent]) -> None:
        """Store the events, those of frames and transmissions in progress separately."""
        self.frames_decoded += [event for event in events if isinstance(event, FrameDecoded)]
        self.marks += [event for event in events if isinstance(event, (TransmissionStarted, TransmissionEnded))]
        separate = (FrameDecoded, TransmissionStarted, TransmissionEnded)
        self.events += [event for event in events if not isinstance(event, separate)]

    def schedule(self, delay_s: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._due, (self.now + delay_s, next(self._order), action))

    def _schedule_reply(self, delay_s: float, action: Callable[[], None]) -> None:
        """Schedule what the modem itself does; a restart cancels it."""
        restarts = self.restarts
        self.schedule(delay_s, lambda: action() if self.restarts == restarts else None)

    def restart(self) -> None:
        """Restart the modem now; it keeps its settings."""
        self._cycle = None
        self.restarts += 1
        self._schedule_reply(self.restart_s, lambda: self.send("CAREV", "000001", "INIT", "2.0.27087"))

    def forget(self) -> None:
        """End the cycle in progress without a word."""
        self._cycle = None
        self._cycle_number += 1
        self._due = []

    def run(self, until_s: float) -> None:
        """Advance the time from deadline to deadline."""
        while True:
            self._take()
            wakeup_s = self.driver.next_wakeup()
            times = [until_s + 1.0] if wakeup_s is None else [max(wakeup_s, self.now)]
            if self._due:
                times.append(self._due[0][0])
            if min(times) > until_s:
                break
            self.now = max(self.now, min(times))
            while self._due and self._due[0][0] <= self.now:
                heapq.heappop(self._due)[2]()
                self._take()
            before = self.driver.next_wakeup()
            self._store(self.driver.poll(self.now))
            after = self.driver.next_wakeup()
            assert after is None or after > self.now or before != after or self._due, (
                "the driver must not request a poll without effect"
            )
        self.now = until_s

    def events_of(self, *kinds: type) -> list[ModemEvent]:
        """Return the events of some types."""
        return [event for event in self.events if isinstance(event, kinds)]

    def commands(self, kind: str) -> list[tuple[str, ...]]:
        """Return the fields of the received commands of a kind."""
        return [sentence.fields for sentence in self.received if sentence.kind == kind]

    def _take(self) -> None:
        for sentence in self._lines.feed(self.driver.bytes_to_send()):
            assert isinstance(sentence, nmea.Sentence), sentence
            self.sentence_counts[sentence.kind] += 1
            if self.unresponsive or self.drops(sentence, self.sentence_counts[sentence.kind]):
                continue
            self.received.append(sentence)
            answer = getattr(self, f"_on_{sentence.kind.lower()}", None)
            assert answer is not None, f"the driver sent {sentence}, which is unknown"
            answer(*sentence.fields)

    def _on_cccfg(self, name: str, value: str) -> None:
        if name not in self.fixed_settings:
            self.settings[name] = value
        if self.echo_settings:
            self._schedule_reply(0.05, lambda: self.send("CACFG", name, value))

    def _on_cccfq(self, name: str) -> None:
        self._schedule_reply(0.05, lambda: self.send("CACFG", name, self.settings[name]))

    def _on_ccmsc(self, *fields: str) -> None:
        assert fields == (self.settings["SRC"], self.settings["SRC"], "0")
        self.restart()

    def _on_cccyc(self, *fields: str) -> None:
        if self._cycle is not None or self.refuses_cycles:
            self._schedule_reply(0.05, lambda: self.send("CAERR", "000000", "CYC", 7, "busy"))
            return
        self._cycle = Cycle.parse(nmea.Sentence("CCCYC", fields))
        self._frames = []
        self._cycle_number += 1
        self._schedule_reply(0.05, lambda: self.send("CACYC", *fields))
        self._schedule_reply(0.10, self.request_data)

    def request_data(self) -> None:
        cycle, number, wanted = self._cycle, self._cycle_number, len(self._frames) + 1
        assert cycle is not None
        size = RATES[cycle.rate].frame_bytes
        self.send("CADRQ", "000000", cycle.src, cycle.dest, int(cycle.ack), size, wanted)

        def give_up() -> None:
            if self._cycle_number == number and self._cycle is not None and len(self._frames) == wanted - 1:
                self.send("CAERR", "000000", "DATA_TIMEOUT", wanted)
                self._cycle = None

        self._schedule_reply(self.data_timeout_s, give_up)

    def _on_cctxd(self, src: str, dest: str, ack: str, data: str) -> None:
        cycle = self._cycle
        if cycle is None or len(self._frames) >= cycle.nframes:
            return
        self._frames.append(bytes.fromhex(data))
        self._schedule_reply(0.05, lambda: self.send("CATXD", src, dest, ack, len(data) // 2))
        self._schedule_reply(0.10, self.request_data if len(self._frames) < cycle.nframes else self.transmit)

    def transmit(self) -> None:
        cycle, frames = self._cycle, tuple(self._frames)
        assert cycle is not None
        size = sum(map(len, frames))
        self._report("TXP", "CATXP", size)

        def end() -> None:
            self.transmitted.append(frames)
            self._cycle = None
            self._report("TXF", "CATXF", size)
            statistics = (7, "20250606", "230117.336548", 3, 0, 200, 5000, 25000, cycle.rate, cycle.src, cycle.dest)
            self._report("XST", "CAXST", *statistics, int(cycle.ack), len(frames), len(frames), 3, size)

        self._schedule_reply(RATES[cycle.rate].airtime_s, end)

    def _report(self, setting: str, kind: str, *fields: str | int) -> None:
        if self.settings[setting] == "1":
            self.send(kind, *fields)
