"""What the modem measured: `CACST` of a reception and `CAXST` of a transmission.

Both have grown with the firmware. The layouts here are those of version 6 and later; fields a sentence
does not have are None, and more fields than these are kept as text. `CACST` of firmware before that has
the same order without the version in front and with a time of day only; it is read too.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from sonarpost.modem.micromodem.fields import FieldReader
from sonarpost.modem.micromodem.nmea import Sentence

FIRST_VERSIONED = 6
"""First version of `CACST` that tells its version."""

_ANY = (-(2**31), 2**31)
_STAMP = re.compile(r"(\d{8})(\d{6})(?:\.(\d{1,9}))?")


@dataclass(frozen=True, slots=True)
class LinkStatistics:
    """`CACST`: how well a packet was received. None is what this modem does not tell.

    Attributes:
        mode: 0 good, 1 bad CRC, 2 time-out.
        arrival_time: As sent: YYYYMMDDhhmmss.ffffff, or hhmmss.ffff before version 6.
        clock: Clock status, hex digits as sent.
        mfd_peak: Matched-filter detector peak.
        mfd_power_db: Its power.
        mfd_ratio: Its ratio.
        spl_db: Sound pressure level of the reception, dB re 1 µPa.
        agn: Analog gain.
        shift_ainp: Gain shifts, as sent, with `shift_ain`, `shift_mfd` and `shift_p2b`.
        rate: Rate number.
        src: Address that sent.
        dest: Address meant.
        psk_error: Error code of the PSK demodulator.
        packet_type: 1 FSK, 2 FSK mini, 3 PSK, 4 PSK mini, 5 flexible data packet.
        nframes: Frames in the packet.
        nbad: Frames among them that failed their check.
        snr_rss_db: Signal level.
        snr_in_db: SNR at the equalizer's input, dB.
        snr_out_db: SNR at its output, dB.
        snr_symbol_db: SNR of the symbols, dB.
        mse_db: Mean squared error of the equalizer, dB.
        dqf: Data quality factor of FSK, -1 for PSK.
        doppler: Doppler as the firmware gives it.
        noise_db: Noise level.
        carrier_hz: Carrier frequency.
        bandwidth_hz: Bandwidth.
        version: Version of the sentence, None before version 6.
        more: Fields beyond these, as text.
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
        read = FieldReader(sentence, ("CACST",), 2)
        first = read.integer(0, "version", 0, 99)
        at = 1 if first >= FIRST_VERSIONED else 0

        def integer(place: int, name: str) -> int | None:
            return read.optional_integer(at + place, name, *_ANY)

        def real(place: int, name: str) -> float | None:
            return read.optional_real(at + place, name)

        return cls(
            mode=read.integer(at, "mode", 0, 255),
            arrival_time=read.text(at + 1),
            clock=read.text(at + 2),
            mfd_peak=integer(3, "mfd_peak"),
            mfd_power_db=integer(4, "mfd_pow"),
            mfd_ratio=integer(5, "mfd_ratio"),
            spl_db=integer(6, "spl"),
            agn=integer(7, "agn"),
            shift_ainp=integer(8, "shift_ainp"),
            shift_ain=integer(9, "shift_ain"),
            shift_mfd=integer(10, "shift_mfd"),
            shift_p2b=integer(11, "shift_p2b"),
            rate=integer(12, "rate"),
            src=integer(13, "src"),
            dest=integer(14, "dest"),
            psk_error=integer(15, "psk_err"),
            packet_type=integer(16, "pkt_type"),
            nframes=integer(17, "nframes"),
            nbad=integer(18, "nbad"),
            snr_rss_db=real(19, "snr_rss"),
            snr_in_db=real(20, "snr_in"),
            snr_out_db=real(21, "snr_out"),
            snr_symbol_db=real(22, "snr_sym"),
            mse_db=real(23, "mse"),
            dqf=integer(24, "dqf"),
            doppler=real(25, "doppler"),
            noise_db=real(26, "noise"),
            carrier_hz=real(27, "carrier"),
            bandwidth_hz=real(28, "bandwidth"),
            version=first if at else None,
            more=sentence.fields[at + 29 :],
        )

    @property
    def good(self) -> bool:
        """Whether the packet was received without an error."""
        return self.mode == 0

    @property
    def arrival_utc(self) -> datetime | None:
        """Time of arrival on the modem's clock; None without a date, or when the clock was never set right."""
        return _utc(self.arrival_time)

    def sentence(self) -> Sentence:
        """Build `CACST` in the layout of `version` (the one without a version where that is None)."""
        values = (
            self.mode, self.arrival_time, self.clock, self.mfd_peak, self.mfd_power_db, self.mfd_ratio,
            self.spl_db, self.agn, self.shift_ainp, self.shift_ain, self.shift_mfd, self.shift_p2b,
            self.rate, self.src, self.dest, self.psk_error, self.packet_type, self.nframes, self.nbad,
            self.snr_rss_db, self.snr_in_db, self.snr_out_db, self.snr_symbol_db, self.mse_db, self.dqf,
            self.doppler, self.noise_db, self.carrier_hz, self.bandwidth_hz,
        )  # fmt: skip
        front = () if self.version is None else (str(self.version),)
        return Sentence("CACST", (*front, *(_text(value) for value in values), *self.more))


@dataclass(frozen=True, slots=True)
class TransmitStatistics:
    """`CAXST`, version 6 and later: what a transmission was. None is what this modem does not tell.

    Attributes:
        version: Version of the sentence.
        date: YYYYMMDD, as sent.
        time: hhmmss.ffffff, as sent.
        clock: Clock status, as sent.
        mode: How the transmission was started.
        probe_length: Length of the probe.
        bandwidth_hz: Bandwidth.
        carrier_hz: Carrier frequency.
        rate: Rate number.
        src: Address that sent.
        dest: Address meant.
        ack: Acknowledgement asked for.
        frames_expected: Frames the modem expected.
        frames_sent: Frames it sent.
        packet_type: As in `LinkStatistics`.
        nbytes: Bytes sent.
        more: Fields beyond these, as text (a newer firmware gives the actual carrier).
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
            mode=read.optional_integer(4, "mode", *_ANY),
            probe_length=read.optional_integer(5, "probe_len", *_ANY),
            bandwidth_hz=read.optional_real(6, "bw"),
            carrier_hz=read.optional_real(7, "carrier"),
            rate=read.optional_integer(8, "rate", *_ANY),
            src=read.optional_integer(9, "src", *_ANY),
            dest=read.optional_integer(10, "dest", *_ANY),
            ack=read.optional_integer(11, "ack", *_ANY),
            frames_expected=read.optional_integer(12, "nexp", *_ANY),
            frames_sent=read.optional_integer(13, "nsent", *_ANY),
            packet_type=read.optional_integer(14, "pkt_type", *_ANY),
            nbytes=read.optional_integer(15, "nbytes", *_ANY),
            more=sentence.fields[16:],
        )

    @property
    def started_utc(self) -> datetime | None:
        """Start of the transmission on the modem's clock; None when that clock was never set right."""
        return _utc(self.date + self.time)

    def sentence(self) -> Sentence:
        """Build `CAXST`."""
        values = (
            self.version, self.date, self.time, self.clock, self.mode, self.probe_length, self.bandwidth_hz,
            self.carrier_hz, self.rate, self.src, self.dest, self.ack, self.frames_expected, self.frames_sent,
            self.packet_type, self.nbytes,
        )  # fmt: skip
        return Sentence("CAXST", (*(_text(value) for value in values), *self.more))


def format_stamp(utc: datetime) -> str:
    """Return YYYYMMDDhhmmss.ffffff, always six digits: shorter fractions have been read as microseconds."""
    return utc.astimezone(UTC).strftime("%Y%m%d%H%M%S.%f")


def _utc(stamp: str) -> datetime | None:
    match = _STAMP.fullmatch(stamp)
    if match is None:
        return None
    try:
        whole = datetime.strptime(match[1] + match[2], "%Y%m%d%H%M%S").replace(tzinfo=UTC)
    except ValueError:
        return None  # an unset clock gives day 0 or hour 99: no time, but no reason to lose the statistics
    return whole + timedelta(seconds=float(f"0.{match[3] or 0}"))


def _text(value: str | float | None) -> str:
    if value is None:
        return ""
    return f"{value:g}" if isinstance(value, float) else str(value)
