"""Statistics of the modem: `CACST` of a reception and `CAXST` of a transmission.

The layouts are those of version 6 and later. Missing fields are None, additional fields are kept as text. `CACST` of
older firmware has the same order, without the version and with a time of day only; it is read too.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sonarpost.modem.micromodem.nmea import FieldReader, Sentence

FIRST_VERSIONED = 6
"""First version of `CACST` that includes its version."""

_TIMESTAMP = re.compile(r"(\d{8})(\d{6})(?:\.(\d{1,9}))?")


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
        fields = sentence.fields[1:] if versioned else sentence.fields
        read = FieldReader(Sentence(sentence.kind, fields))
        return cls(
            mode=read.integer(0, "mode", 0, 255),
            arrival_time=read.text(1),
            clock=read.text(2),
            mfd_peak=read.optional_integer(3, "mfd_peak"),
            mfd_power_db=read.optional_integer(4, "mfd_pow"),
            mfd_ratio=read.optional_integer(5, "mfd_ratio"),
            spl_db=read.optional_integer(6, "spl"),
            agn=read.optional_integer(7, "agn"),
            shift_ainp=read.optional_integer(8, "shift_ainp"),
            shift_ain=read.optional_integer(9, "shift_ain"),
            shift_mfd=read.optional_integer(10, "shift_mfd"),
            shift_p2b=read.optional_integer(11, "shift_p2b"),
            rate=read.optional_integer(12, "rate"),
            src=read.optional_integer(13, "src"),
            dest=read.optional_integer(14, "dest"),
            psk_error=read.optional_integer(15, "psk_err"),
            packet_type=read.optional_integer(16, "pkt_type"),
            nframes=read.optional_integer(17, "nframes"),
            nbad=read.optional_integer(18, "nbad"),
            snr_rss_db=read.optional_real(19, "snr_rss"),
            snr_in_db=read.optional_real(20, "snr_in"),
            snr_out_db=read.optional_real(21, "snr_out"),
            snr_symbol_db=read.optional_real(22, "snr_sym"),
            mse_db=read.optional_real(23, "mse"),
            dqf=read.optional_integer(24, "dqf"),
            doppler=read.optional_real(25, "doppler"),
            noise_db=read.optional_real(26, "noise"),
            carrier_hz=read.optional_real(27, "carrier"),
            bandwidth_hz=read.optional_real(28, "bandwidth"),
            version=first if versioned else None,
            more=fields[29:],
        )

    @property
    def good(self) -> bool:
        """Whether the packet was received without an error."""
        return self.mode == 0

    @property
    def arrival_utc(self) -> datetime | None:
        """Time of arrival on the modem's clock; None without a date, or when the clock was never set."""
        return _utc(self.arrival_time)


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
        read = FieldReader(sentence, ("CAXST",), 3)
        return cls(
            version=read.integer(0, "version", 0, 99),
            date=read.text(1),
            time=read.text(2),
            clock=read.text(3),
            mode=read.optional_integer(4, "mode"),
            probe_length=read.optional_integer(5, "probe_len"),
            bandwidth_hz=read.optional_real(6, "bw"),
            carrier_hz=read.optional_real(7, "carrier"),
            rate=read.optional_integer(8, "rate"),
            src=read.optional_integer(9, "src"),
            dest=read.optional_integer(10, "dest"),
            ack=read.optional_integer(11, "ack"),
            frames_expected=read.optional_integer(12, "nexp"),
            frames_sent=read.optional_integer(13, "nsent"),
            packet_type=read.optional_integer(14, "pkt_type"),
            nbytes=read.optional_integer(15, "nbytes"),
            more=sentence.fields[16:],
        )

    @property
    def started_utc(self) -> datetime | None:
        """Start of the transmission on the modem's clock; None when the clock was never set."""
        return _utc(self.date + self.time)


def _utc(timestamp: str) -> datetime | None:
    match = _TIMESTAMP.fullmatch(timestamp)
    if match is None:
        return None
    try:
        whole = datetime.strptime(match[1] + match[2], "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    except ValueError:
        return None  # a clock that was never set reports day 0 or hour 99; the other statistics are valid
    return whole + timedelta(seconds=float(f"0.{match[3] or 0}"))
