"""Log of the channel: one JSON object a line, flushed line by line.

Values of `event`:

- `start`: settings, and position and device of every modem.
- `client`: a host opened or closed a modem's port.
- `packet`: outcome of one packet at one receiver, with every frame. The line is written when the packet's sentences
  have been written to the receiver's port (`heard` is true), or when it is certain that they will not be (`heard` is
  false, and `not_heard_because` holds the reason). The outcome of a frame is the channel's; `heard` is the host's side.
- `stop` and, last, `totals`.

`hex` and `sha256` of a frame are of the received bytes (delivered, damaged) or of the bytes sent (lost). A damaged
frame also has `sent_hex`. `source`, `destination` and `receiver` are addresses; `transmitter_modem` and
`receiver_modem` are modem numbers. `packet` counts the transmitting modem's packets from 1. `time_s` is the simulated
time at which the packet had passed the receiver.
"""

import contextlib
import hashlib
import json
import logging
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from sonarpost.errors import PortError
from sonarpost.extensions.simulation.channel.events import FrameArrival, FrameOutcome
from sonarpost.extensions.simulation.modem.receiver import PacketReport

log = logging.getLogger(__name__)


@dataclass(slots=True)
class PacketTotals:
    """Counts since the start.

    Attributes:
        transmitted: Packets transmitted.
        reported: Packets written to a host, counted at each receiver.
        unreported: Packets not written to a host, by reason, counted at each receiver.
        frames: Frames by outcome, counted at each receiver.
    """

    transmitted: int = 0
    reported: int = 0
    unreported: Counter[str] = field(default_factory=Counter)
    frames: Counter[str] = field(default_factory=lambda: Counter({outcome.value: 0 for outcome in FrameOutcome}))


class PacketLog:
    """Writes the log and counts packets and frames.

    Attributes:
        totals: The counts so far.

    Args:
        path: File to append to, or None to count only.
        echo: A second output for every line, for example standard output.

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
        self.totals = PacketTotals()

    def write(self, event: str, time_s: float, real_time_utc_s: float, **fields: object) -> None:
        """Write one line.

        Raises:
            PortError: The line cannot be written.
        """
        record = {"event": event, "time_s": round(time_s, 6), "real_time_utc_s": round(real_time_utc_s, 6), **fields}
        line = json.dumps(record) + "\n"
        try:
            if self._file is not None:
                self._file.write(line)
                self._file.flush()
        except OSError as error:
            raise PortError(f"the log cannot be written: {error}") from error
        self._write_echo(line)

    def _write_echo(self, line: str) -> None:
        if self._echo is None:
            return
        try:
            self._echo.write(line)
            self._echo.flush()
        except BrokenPipeError:
            log.info("Reader of the log's second output has closed it; continuing without")
            self._echo = None
        except OSError as error:
            raise PortError(f"the log's second output cannot be written: {error}") from error

    def packet(self, report: PacketReport, unreported_reason: str | None, real_time_utc_s: float) -> None:
        """Write and count the outcome of a packet at a receiver."""
        for frame in report.arrival.frames:
            self.totals.frames[frame.outcome.value] += 1
        if unreported_reason is None:
            self.totals.reported += 1
        else:
            self.totals.unreported[unreported_reason] += 1
        self.write("packet", report.arrival.time_s, real_time_utc_s, **_packet_fields(report, unreported_reason))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            # Every line was flushed: closing fails only over a line whose error `write` has raised already.
            with contextlib.suppress(OSError):
                self._file.close()


def _packet_fields(report: PacketReport, unreported_reason: str | None) -> dict[str, object]:
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
        "heard": unreported_reason is None,
        "not_heard_because": unreported_reason,
        "frames": [_frame_fields(frame) for frame in arrival.frames],
    }


def _frame_fields(frame: FrameArrival) -> dict[str, object]:
    data = frame.sent if frame.outcome is FrameOutcome.LOST else frame.received
    fields: dict[str, object] = {
        "number": frame.number,
        "bytes": len(data),
        "fate": frame.outcome.value,
        "sha256": hashlib.sha256(data).hexdigest(),
        "hex": data.hex(),
    }
    if frame.outcome is FrameOutcome.DAMAGED:
        fields["sent_hex"] = frame.sent.hex()
    return fields
