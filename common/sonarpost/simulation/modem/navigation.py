"""Ranging to transponders with the emulated modem: `CCPDT` (REMUS) and `CCPNT` (narrow-band), answered by `SNTTA`.

The ping goes into the water and disturbs whoever listens there; the transponders themselves are no modems. Each answers
after the turn-around time `TAT`, and counts when its answer is back within the time-out of the command. The modem tells
the one-way travel times when the time-out is over, with the time at which it pinged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sonarpost.modem.micromodem import nmea
from sonarpost.simulation.channel.channel_events import AcousticPacket, PacketKind
from sonarpost.simulation.modem import commands
from sonarpost.simulation.modem.settings import ModemClock, ModemSettings
from sonarpost.simulation.modem.transmitter import BusyError, Transmitter

PING_S = 0.01

TravelTimes = Callable[[], Mapping[str, float]]
"""Gives the one-way travel time, in seconds, to every transponder by its letter."""


@dataclass(frozen=True, slots=True)
class _Ranging:
    """A ping whose answers are waited for."""

    pinged_s: float
    ends_s: float
    answers: Mapping[str, float]


class TransponderRanging:
    """Pings transponders for one modem.

    Args:
        settings: The modem's.
        clock: The modem's.
        transmitter: The modem's.
        travel_times: Asked at each ping.
        write: Takes each sentence for the host.
    """

    def __init__(
        self,
        settings: ModemSettings,
        clock: ModemClock,
        transmitter: Transmitter,
        travel_times: TravelTimes,
        write: Callable[[bytes], None],
    ) -> None:
        self._settings = settings
        self._clock = clock
        self._transmitter = transmitter
        self._travel_times = travel_times
        self._write = write
        self._ranging: _Ranging | None = None

    @property
    def busy(self) -> bool:
        """Whether answers are waited for."""
        return self._ranging is not None

    @property
    def deadline_s(self) -> float | None:
        """When `poll` has something to do, or None."""
        return self._ranging.ends_s if self._ranging else None

    def forget(self) -> None:
        """Forget everything (the modem reboots)."""
        self._ranging = None

    def start(self, sentence: nmea.Sentence, now: float) -> None:
        """Act on `CCPDT` and `CCPNT`.

        Raises:
            SentenceError: It does not parse.
            BusyError: A cycle, transmission or ping of the host's is not over.
        """
        asked = commands.ranging(sentence)
        self._transmitter.check_free(sentence)
        if self._ranging is not None:
            raise BusyError(sentence.kind, "moment", "", "the end of the ranging before it")
        self._write(nmea.format("SN" + sentence.kind[2:], *sentence.fields))
        turnaround_s = self._settings["TAT"] / 1000
        answers = {
            letter: travel_s
            for letter, travel_s in self._travel_times().items()
            if letter in asked.beacons and 2 * travel_s + turnaround_s <= asked.timeout_s
        }
        self._ranging = _Ranging(now, now + max(asked.timeout_s, PING_S), answers)
        self._transmitter.send_when_free(
            AcousticPacket(PacketKind.NAVIGATION, self._settings["SRC"], 0, 0, PING_S), now
        )

    def poll(self, now: float) -> None:
        """Tell the travel times when the time-out is over; a transponder that did not answer has an empty field."""
        if self._ranging is None or now < self._ranging.ends_s:
            return
        ranging, self._ranging = self._ranging, None
        times = [f"{ranging.answers[letter]:.4f}" if letter in ranging.answers else "" for letter in "ABCD"]
        pinged = self._clock.at(ranging.pinged_s).strftime("%H%M%S.%f")[:-2]
        self._write(nmea.format("SNTTA", *times, pinged))
