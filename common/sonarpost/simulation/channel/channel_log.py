"""The record of what the water did: one JSON object a line, flushed line by line.

Lines, by `event`:

- `start`: settings, and where each modem is and what hosts open.
- `client`: a host opened or left a modem's port. `move`: a modem was put elsewhere.
- `packet`: what became of one packet at one receiver, with every frame. Written when its bytes have been written to
  the receiver's port (`heard` true), or when it is certain that they will not be (`heard` false, with the reason in
  `not_heard_because`): "delivered" is what the water did, `heard` whether a host was told.
- `stop` and, last, `totals`.

`hex` and `sha256` of a frame are what the receiver got (delivered, damaged), or what was sent (lost); a damaged frame
also has `sent_hex`. `source`, `destination` and `receiver` are addresses; `transmitter_modem` and `receiver_modem` are
the emulator's numbers. `packet` counts the transmitting modem's packets from 1. `time_s` is the simulated time at
which the packet had passed the receiver.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from sonarpost.errors import PortError
from sonarpost.simulation.channel.channel_events import FrameArrival, FrameOutcome
from sonarpost.simulation.modem.config import PacketReport

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Totals:
    """Counts since the start.

    Attributes:
        transmitted: Packets put into the water.
        heard: Packets told to a host, counted at each receiver.
        not_heard: Packets not told, by reason, counted at each receiver.
        frames: Frames by fate, counted at each receiver.
    """

    transmitted: int
    heard: int
    not_heard: Mapping[str, int]
    frames: Mapping[str, int]


class PacketLog:
    """Writes the log and keeps the totals.

    Args:
        path: File to append to, or None for totals only.
        echo: A second place for every line, for example standard output.

    Raises:
        PortError: The file cannot be opened.
    """

    def __init__(self, path: Path | None, echo: IO[str] | None = None) -> None:
        self._echo = echo
        self._file: IO[str] | None = None
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = path.open("a", encoding="utf-8")
            except OSError as error:
                raise PortError(f"{path}: the log cannot be written: {error}") from error
        self.transmitted = 0
        self.frames: Counter[str] = Counter({fate.value: 0 for fate in FrameOutcome})
        self.heard = 0
        self.not_heard: Counter[str] = Counter()

    def write(self, event: str, time_s: float, real_time_utc_s: float, **fields: object) -> None:
        """Write one line.

        Raises:
            PortError: The disk is full or gone.
        """
        record = {"event": event, "time_s": round(time_s, 6), "real_time_utc_s": round(real_time_utc_s, 6), **fields}
        line = json.dumps(record) + "\n"
        try:
            if self._file is not None:
                self._file.write(line)
                self._file.flush()
        except OSError as error:
            raise PortError(f"the log cannot be written: {error}") from error
        self._show(line)

    def _show(self, line: str) -> None:
        if self._echo is None:
            return
        try:
            self._echo.write(line)
            self._echo.flush()
        except BrokenPipeError:
            # Whoever watched has left; the modems are there for their hosts.
            log.info("Nobody reads the log's second place any more")
            self._echo = None
        except OSError as error:
            raise PortError(f"the log cannot be shown: {error}") from error

    def packet(self, report: PacketReport, not_heard_because: str | None, real_time_utc_s: float) -> None:
        """Write what became of a packet at a receiver, and count it."""
        arrival = report.arrival
        for frame in arrival.frames:
            self.frames[frame.fate.value] += 1
        if not_heard_because is None:
            self.heard += 1
        else:
            self.not_heard[not_heard_because] += 1
        self.write("packet", arrival.at_s, real_time_utc_s, **packet_fields(report, not_heard_because))

    def totals(self) -> Totals:
        """Return the counts so far."""
        return Totals(self.transmitted, self.heard, dict(self.not_heard), dict(self.frames))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            # Every line was flushed, so closing only fails over a line whose failure `write` has raised already.
            with contextlib.suppress(OSError):
                self._file.close()


def packet_fields(report: PacketReport, not_heard_because: str | None) -> dict[str, object]:
    """Return the fields of a `packet` line, without event and times."""
    arrival = report.arrival
    sent = arrival.transmission
    return {
        "packet": sent.number,
        "kind": sent.packet.kind.value,
        "source": sent.packet.source,
        "destination": sent.packet.destination,
        "receiver": report.address,
        "transmitter_modem": sent.transmitter,
        "receiver_modem": arrival.receiver,
        "rate": sent.packet.rate,
        "airtime_s": sent.packet.airtime_s,
        "transmitted_s": round(sent.started_s, 6),
        "range_m": round(arrival.range_m, 3),
        "snr_db": round(arrival.snr_db, 2),
        "outcome": arrival.outcome.value,
        "heard": not_heard_because is None,
        "not_heard_because": not_heard_because,
        "frames": _frames(arrival.frames),
    }


def _frames(frames: Sequence[FrameArrival]) -> list[dict[str, object]]:
    shown: list[dict[str, object]] = []
    for frame in frames:
        data = frame.sent if frame.fate is FrameOutcome.LOST else frame.received
        entry: dict[str, object] = {
            "number": frame.number,
            "bytes": len(data),
            "fate": frame.fate.value,
            "sha256": hashlib.sha256(data).hexdigest(),
            "hex": data.hex(),
        }
        if frame.fate is FrameOutcome.DAMAGED:
            entry["sent_hex"] = frame.sent.hex()
        shown.append(entry)
    return shown
