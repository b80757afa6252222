"""Statistics of the modem: `CACST` of a reception and `CAXST` of a transmission.

The layouts are those of version 6 and later. Missing fields are None, additional fields are kept as text. `CACST` of
older firmware has the same order, without the version and with a time of day only; it is read too. The attributes up to
the version or `more` have the order of the fields in the sentence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass, fields
from typing import Any

from sonarpost.modem.micromodem.nmea import FieldReader, Sentence

FIRST_VERSIONED = 6
"""First version of `CACST` that includes its version."""


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """`CACST`: reception quality of a packet. None where this modem does not report a value.

    Attributes:
        mode: 0 good, 1 bad CRC, 2 time-out.
        arrival_time: As sent: YYYYMMDDhhmmss.ffffff, or hhmmss.ffff before version 6.
        mfd_peak: Peak of the matched-filter detector, like `mfd_power_db` and `mfd_ratio`.
        spl_db: Sound pressure level of the reception, dB re 1 µPa.
        agn: Analog gain.
        shift_ainp: Gain shift, as sent, like `shift_ain`, `shift_mfd` and `shift_p2b`.
        psk_error: Error code of the PSK demodulator.
        packet_type: 1 FSK, 2 FSK mini, 3 PSK, 4 PSK mini, 5 flexible data.
        nbad: Frames that failed their check.
        snr_rss_db: Signal level.
        snr_in_db: SNR at the equalizer's input, dB.
        snr_out_db: SNR at the equalizer's output, dB.
        mse_db: Mean squared error of the equalizer, dB.
        dqf: Data quality factor of FSK, -1 for PSK.
        version: Version of the sentence, None before version 6.
        more: Additional fields, as text.
    """

    mode: int
    arrival_time: str = ""
    clock: str = ""
    mfd_peak: int | None = None
    mfd_power_db: int | None = None
    mfd_ratio: int | None = None
    spl_db: int | None = None
    agn: int | None = None
    shift_ainp: int | None = None
    shift_ain: int | None = None
    shift_mfd: int | None = None
    shift_p2b: int | None = None
    rate: int | None = None
    src: int | None = None
    dest: int | None = None
    psk_error: int | None = None
    packet_type: int | None = None
    nframes: int | None = None
    nbad: int | None = None
    snr_rss_db: float | None = None
    snr_in_db: float | None = None
    snr_out_db: float | None = None
    snr_symbol_db: float | None = None
    mse_db: float | None = None
    dqf: int | None = None
    doppler: float | None = None
    noise_db: float | None = None
    carrier_hz: float | None = None
    bandwidth_hz: float | None = None
    version: int | None = FIRST_VERSIONED
    more: tuple[str, ...] = ()

    @classmethod
    def parse(cls, sentence: Sentence) -> LinkStatistics:
        """Read `CACST`."""
        first = FieldReader(sentence, ("CACST",), 2).integer(0, "version", 0, 99)
        versioned = first >= FIRST_VERSIONED
        texts = sentence.fields[1:] if versioned else sentence.fields
        values = _read(FieldReader(Sentence(sentence.kind, texts)), fields(cls)[:-2])
        return cls(**values, version=first if versioned else None, more=texts[len(values) :])

    @property
    def good(self) -> bool:
        """Whether the packet was received without an error."""
        return self.mode == 0


@dataclass(frozen=True, slots=True)
class TransmitStatistics:
    """`CAXST`, version 6 and later: one transmission. None where this modem does not report a value.

    Attributes:
        date: YYYYMMDD, as sent.
        time: hhmmss.ffffff, as sent.
        packet_type: As in `LinkStatistics`.
        more: Additional fields, as text (newer firmware adds the actual carrier).
    """

    version: int
    date: str
    time: str
    clock: str = ""
    mode: int | None = None
    probe_length: int | None = None
    bandwidth_hz: float | None = None
    carrier_hz: float | None = None
    rate: int | None = None
    src: int | None = None
    dest: int | None = None
    ack: int | None = None
    frames_expected: int | None = None
    frames_sent: int | None = None
    packet_type: int | None = None
    nbytes: int | None = None
    more: tuple[str, ...] = ()

    @classmethod
    def parse(cls, sentence: Sentence) -> TransmitStatistics:
        """Read `CAXST`."""
        values = _read(FieldReader(sentence, ("CAXST",), 3), fields(cls)[:-1])
        return cls(**values, more=sentence.fields[len(values) :])


def _read(read: FieldReader, attributes: Sequence[Field[Any]]) -> dict[str, Any]:
    """Return the values of attributes by name; their order is that of the sentence, and the type selects the reader."""
    readers: dict[object, Callable[[int, str], object]] = {
        "int": lambda index, name: read.integer(index, name, 0, 255),
        "str": read.text,
        "int | None": read.optional_integer,
        "float | None": read.optional_real,
    }
    return {each.name: readers[each.type](index, each.name) for index, each in enumerate(attributes)}
