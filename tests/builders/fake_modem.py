"""A scripted modem for the driver's tests: answers as the fact sheet says, and loses the sentences it is told to."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable
from itertools import count

from sonarpost.modem.micromodem import RATES, FrameDecoded, MicroModem, ModemEvent, nmea
from sonarpost.modem.micromodem.sentences import Cycle

Loses = Callable[[nmea.Sentence, int], bool]


def never(sentence: nmea.Sentence, nth: int) -> bool:
    """Lose nothing."""
    return False


def nth_of(kind: str, nth: int) -> Loses:
    """Lose the nth (from 1) sentence of a kind, once."""
    return lambda sentence, seen: sentence.kind == kind and seen == nth


class FakeModem:
    """The modem's side and the simulated clock; `run` lets the driver and it talk until a given time.

    Args:
        driver: The driver under test.
        loses: Tells which sentences never arrive, in either direction, by the sentence and how many of its kind
            have been sent so far, itself included.
    """

    data_timeout_s = 4.0

    def __init__(self, driver: MicroModem, loses: Loses = never) -> None:
        self.driver = driver
        self.loses = loses
        self.now = 0.0
        self.settings = {"SRC": "0", "CST": "0", "RXP": "0"}
        self.events: list[ModemEvent] = []
        self.frames_heard: list[FrameDecoded] = []
        self.heard: list[nmea.Sentence] = []
        self.on_air: list[tuple[bytes, ...]] = []
        self.dead = False
        self.silent_kinds: set[str] = set()
        self.echo_settings = True
        self._cycle: Cycle | None = None
        self._frames: list[bytes] = []
        self._cycle_number = 0
        self._seen: Counter[str] = Counter()
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._order = count()
        self._lines = nmea.LineAssembler("host")

    def say(self, kind: str, *fields: str | int) -> None:
        """Send a sentence to the driver now."""
        sentence = nmea.Sentence(kind, tuple(str(f) for f in fields))
        self._seen[kind] += 1
        if not self.dead and kind not in self.silent_kinds and not self.loses(sentence, self._seen[kind]):
            self._note(self.driver.receive(sentence.encode(), self.now))

    def raw(self, data: bytes) -> None:
        """Send any bytes to the driver now."""
        self._note(self.driver.receive(data, self.now))

    def _note(self, events: list[ModemEvent]) -> None:
        """Keep the events; a frame's first news apart from the packets' story."""
        self.frames_heard += [event for event in events if isinstance(event, FrameDecoded)]
        self.events += [event for event in events if not isinstance(event, FrameDecoded)]

    def later(self, delay_s: float, action: Callable[[], None]) -> None:
        heapq.heappush(self._due, (self.now + delay_s, next(self._order), action))

    def run(self, until_s: float) -> None:
        """Let time pass, from one deadline to the next."""
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
            self._note(self.driver.poll(self.now))
            after = self.driver.next_wakeup()
            assert after is None or after > self.now or before != after or self._due, (
                "the driver asks to be polled for nothing"
            )
        self.now = until_s

    def of(self, *kinds: type) -> list[ModemEvent]:
        """The events of some types."""
        return [event for event in self.events if isinstance(event, kinds)]

    def commands(self, kind: str) -> list[tuple[str, ...]]:
        """The fields of the sentences of a kind that have arrived from the driver."""
        return [sentence.fields for sentence in self.heard if sentence.kind == kind]

    def _take(self) -> None:
        for sentence in self._lines.feed(self.driver.bytes_to_send()):
            assert isinstance(sentence, nmea.Sentence), sentence
            self._seen[sentence.kind] += 1
            if self.dead or self.loses(sentence, self._seen[sentence.kind]):
                continue
            self.heard.append(sentence)
            answer = getattr(self, f"_on_{sentence.kind.lower()}", None)
            assert answer is not None, f"the driver sent {sentence}, which no modem knows"
            answer(*sentence.fields)

    def _on_cccfg(self, name: str, value: str) -> None:
        self.settings[name] = value
        if self.echo_settings:
            self.later(0.05, lambda: self.say("CACFG", name, value))

    def _on_cccfq(self, name: str) -> None:
        self.later(0.05, lambda: self.say("CACFG", name, self.settings[name]))

    def _on_ccclk(self, *fields: str) -> None:
        self.later(0.05, lambda: self.say("CACLK", *fields))

    def _on_cccyc(self, *fields: str) -> None:
        if self._cycle is not None:
            self.later(0.05, lambda: self.say("CAERR", "000000", "CYC", 7, "busy"))
            return
        self._cycle = Cycle.parse(nmea.Sentence("CCCYC", fields))
        self._frames = []
        self._cycle_number += 1
        self.later(0.05, lambda: self.say("CACYC", *fields))
        self.later(0.10, self._ask)

    def _ask(self) -> None:
        cycle, number, wanted = self._cycle, self._cycle_number, len(self._frames) + 1
        assert cycle is not None
        size = RATES[cycle.rate].frame_bytes
        self.say("CADRQ", "000000", cycle.src, cycle.dest, int(cycle.ack), size, wanted)

        def give_up() -> None:
            if self._cycle_number == number and self._cycle is not None and len(self._frames) == wanted - 1:
                self.say("CAERR", "000000", "DATA_TIMEOUT", wanted)
                self._cycle = None

        self.later(self.data_timeout_s, give_up)

    def _on_cctxd(self, src: str, dest: str, ack: str, data: str) -> None:
        cycle = self._cycle
        if cycle is None or len(self._frames) >= cycle.nframes:
            return
        self._frames.append(bytes.fromhex(data))
        self.later(0.05, lambda: self.say("CATXD", src, dest, ack, len(data) // 2))
        self.later(0.10, self._ask if len(self._frames) < cycle.nframes else self._transmit)

    def _transmit(self) -> None:
        cycle, frames = self._cycle, tuple(self._frames)
        assert cycle is not None
        size = sum(map(len, frames))
        self.say("CATXP", size)

        def end() -> None:
            self.on_air.append(frames)
            self._cycle = None
            self.say("CATXF", size)
            self.say("CAXST", 7, "20250606", "230117.336548", 3, 0, 200, 5000, 25000, cycle.rate, cycle.src, cycle.dest,
                     int(cycle.ack), len(frames), len(frames), 3, size)  # fmt: skip

        self.later(RATES[cycle.rate].airtime_s, end)
