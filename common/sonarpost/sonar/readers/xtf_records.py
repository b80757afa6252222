"""Parsing and validation of the records of an XTF file.

The structures are those of pyxtf. Its file reader is not used, because it does not validate the file. It does not
terminate on a record of length zero, and returns short sample arrays for a truncated packet. It selects the sample size
of a channel by position in the ping and not by channel number. It unpickles any `.pyxtf_idx` file beside the survey.

Field meanings are those of the XTF file format, revision 35 and later:

* A port channel is stored farthest sample first, so that port and starboard side by side form an image. It is
  reversed here: index 0 is nearest the vehicle on both sides.
* Speed is in knots, slant range in metres, frequency in kHz.
"""

from __future__ import annotations

import ctypes
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

import numpy as np
from pyxtf import XTFAttitudeData, XTFChanInfo, XTFFileHeader, XTFPingChanHeader, XTFPingHeader

from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Samples, Side

FILE_MAGIC: Final = 0x7B
MAX_CHANNELS: Final = 64
HEADER_BYTES: Final = ctypes.sizeof(XTFFileHeader)

_CHAN_INFO_BYTES: Final = ctypes.sizeof(XTFChanInfo)
_CHAN_INFO_OFFSET: Final = 256
_PING_BYTES: Final = ctypes.sizeof(XTFPingHeader)
_PING_CHAN_BYTES: Final = ctypes.sizeof(XTFPingChanHeader)
_SIDES: Final = {1: Side.PORT, 2: Side.STARBOARD}
_CHANNEL_NAMES: Final = {0: "sub-bottom", 3: "bathymetry"}
_SAMPLE_BYTES: Final = (1, 2, 4)
_FORMAT_BYTES: Final = {2: 4, 3: 2, 8: 1}
"""SampleFormat of the integer encodings and their sizes; 0: the file is older than the field."""
_GROUND_RANGE: Final = 2
_MAX_WEIGHT: Final = 31
_DELAY_AGREEMENT: Final = 0.02
"""Maximum relative difference between slant range and time for a delayed recording."""


@dataclass(frozen=True, slots=True)
class Attitude:
    """An attitude packet: time and angles of a motion sensor."""

    time_utc_s: float
    pitch_deg: float
    roll_deg: float
    heading_deg: float


def read_header(reader: SequentialReader, file: CheckedFile) -> tuple[XTFFileHeader, list[XTFChanInfo]]:
    """Read the file header with its channels.

    Raises:
        SurveyFileError: Not an XTF file, truncated, or invalid channel counts.
    """
    raw = reader.read(HEADER_BYTES, "file header")
    header = XTFFileHeader.from_buffer_copy(raw)
    if header.FileFormat != FILE_MAGIC:
        raise file.error("FileFormat", hex(header.FileFormat), hex(FILE_MAGIC))
    count = int(header.channel_count())
    if not 1 <= count <= MAX_CHANNELS or not header.NumberOfSonarChannels:
        expected = f"1 to {MAX_CHANNELS} channels, at least one of them sonar"
        raise file.error("channel counts", (int(header.NumberOfSonarChannels), count), expected)
    # The header contains six channels; every further eight channels add 1024 bytes.
    extra = math.ceil(max(count - 6, 0) / 8)
    raw += reader.read(1024 * extra, "file header")
    offsets = range(_CHAN_INFO_OFFSET, _CHAN_INFO_OFFSET + (6 + 8 * extra) * _CHAN_INFO_BYTES, _CHAN_INFO_BYTES)
    return header, [XTFChanInfo.from_buffer_copy(raw, offset) for offset in offsets]


def parse_attitude(raw: bytes) -> Attitude | None:
    """Parse an attitude packet; None if it is too short, has no valid date or no valid angles."""
    if len(raw) < ctypes.sizeof(XTFAttitudeData):
        return None
    data = XTFAttitudeData.from_buffer_copy(raw)
    values = (float(data.Pitch), float(data.Roll), float(data.Heading))
    try:
        when = datetime(data.Year, data.Month, data.Day, data.Hour, data.Minute, data.Second, tzinfo=UTC)
    except ValueError:
        return None
    if not (abs(values[0]) <= 90 and abs(values[1]) <= 180 and 0 <= values[2] < 360):  # excludes NaN
        return None
    return Attitude(when.timestamp() + float(data.Millisecond) / 1000, *values)


class PingParser:
    """Parses the sonar packets of one file; `notes` counts skipped and corrected data."""

    def __init__(self, file: CheckedFile, channels: list[XTFChanInfo], *, port_farthest_first: bool) -> None:
        self._file = file
        self._channels = channels
        self._reverse = {Side.PORT: port_farthest_first, Side.STARBOARD: False}
        self.notes: Counter[str] = Counter()

    def header(self, raw: bytes, place: str) -> tuple[XTFPingHeader, float]:
        """Parse the header of a ping and its time, UTC seconds since 1970.

        Raises:
            SurveyFileError: The packet is too short or has no valid date.
        """
        if len(raw) < _PING_BYTES:
            raise self._file.error(f"{place}, NumBytesThisRecord", len(raw), f"at least {_PING_BYTES} for a ping")
        head = XTFPingHeader.from_buffer_copy(raw)
        return head, self._time(head, f"ping {head.PingNumber}, {place}")

    def _time(self, head: XTFPingHeader, where: str) -> float:
        stamp = (head.Year, head.Month, head.Day, head.Hour, head.Minute, head.Second)
        expected = "a UTC date and time, hundredths 0 to 100"
        if head.HSeconds > 100:
            raise self._file.error(f"{where}, HSeconds", head.HSeconds, expected)
        try:
            whole = datetime(*stamp, tzinfo=UTC)
        except ValueError as error:
            raise self._file.error(f"{where}, date and time", stamp, expected) from error
        return whole.timestamp() + float(head.HSeconds) / 100

    def channels(self, raw: bytes, head: XTFPingHeader, place: str) -> Iterator[ChannelPing]:
        """Yield the side-scan channels of a ping.

        Raises:
            SurveyFileError: A channel exceeds the packet, or its samples are not integers.
        """
        where = f"ping {head.PingNumber}, {place}"
        count = int(head.NumChansToFollow)
        offset = _PING_BYTES
        for _ in range(count):
            if offset + _PING_CHAN_BYTES > len(raw):
                raise self._file.error(f"{where}, NumChansToFollow", count, "as many channels as the record holds")
            channel_head = XTFPingChanHeader.from_buffer_copy(raw, offset)
            offset += _PING_CHAN_BYTES
            number = int(channel_head.ChannelNumber)
            if number >= len(self._channels):
                raise self._file.error(f"{where}, ChannelNumber", number, f"0 to {len(self._channels) - 1}")
            info = self._channels[number]
            bytes_per_sample = self._sample_bytes(info, number)
            samples = int(channel_head.NumSamples) or int(info.Reserved)  # older files: in the header
            end = offset + samples * bytes_per_sample
            if end > len(raw):
                limit = (len(raw) - offset) // bytes_per_sample
                raise self._file.error(f"{where}, channel {number}, NumSamples", samples, f"at most {limit}")
            channel = self._channel_ping(channel_head, info, raw[offset:end], float(head.SoundVelocity))
            offset = end
            if channel is not None:
                yield channel

    def _sample_bytes(self, info: XTFChanInfo, number: int) -> int:
        size = int(info.BytesPerSample)
        if size not in _SAMPLE_BYTES:
            raise self._file.error(f"channel {number}, BytesPerSample", size, "1, 2 or 4")
        # Only side-scan channels must contain integers; other channels are skipped.
        if info.TypeOfChannel in _SIDES and info.SampleFormat and _FORMAT_BYTES.get(info.SampleFormat) != size:
            expected = f"0, or the unsigned integer of {size} bytes"
            raise self._file.error(f"channel {number}, SampleFormat", info.SampleFormat, expected)
        if info.TypeOfChannel in _SIDES and info.CorrectionFlags == _GROUND_RANGE:
            raise self._file.error(
                f"channel {number}, CorrectionFlags", info.CorrectionFlags, "slant-range samples (1)"
            )
        return size

    def _channel_ping(
        self, head: XTFPingChanHeader, info: XTFChanInfo, raw: bytes, sound_velocity_mps: float
    ) -> ChannelPing | None:
        side = _SIDES.get(info.TypeOfChannel)
        if side is None:
            name = _CHANNEL_NAMES.get(info.TypeOfChannel, f"type {info.TypeOfChannel}")
            self.notes[f"skipped channel: {name}, not side-scan"] += 1
            return None
        slant_range_m = float(head.SlantRange)
        if not raw or not 0 < slant_range_m <= MAX_SLANT_RANGE_M:  # includes NaN
            self.notes[f"skipped {side.value} channel: no samples or no slant range"] += 1
            return None
        samples = _samples(raw, info.BytesPerSample, reverse=self._reverse[side])
        if head.TimeDelay:
            delayed = _with_delay(samples, slant_range_m, head, sound_velocity_mps)
            if delayed is None:
                self.notes[f"skipped {side.value} channel: TimeDelay, SlantRange and TimeDuration disagree"] += 1
                return None
            self.notes["recording began after the transmission (TimeDelay): zeros replace the missing samples"] += 1
            samples, slant_range_m = delayed
        return ChannelPing(
            side=side,
            samples=samples,
            slant_range_m=slant_range_m,
            frequency_hz=_frequency_hz(float(head.Frequency) or info.Frequency),
            scale=self._scale(int(head.Weight)),
        )

    def _scale(self, weight: int) -> float:
        """Return the scale of a weight N: echo strength is the sample times 2^-N."""
        if not -_MAX_WEIGHT <= weight <= _MAX_WEIGHT:
            self.notes[f"sample weight beyond ±{_MAX_WEIGHT} is not applied"] += 1
            return 1.0
        return math.ldexp(1.0, -weight)


def _samples(raw: bytes, bytes_per_sample: int, *, reverse: bool) -> Samples:
    """Return little-endian unsigned integers in native byte order, reversed if requested."""
    samples = np.frombuffer(raw, dtype=f"<u{bytes_per_sample}")[:: -1 if reverse else 1]
    return samples.astype(f"u{bytes_per_sample}")  # a copy in any case


def _with_delay(
    samples: Samples, slant_range_m: float, head: XTFPingChanHeader, velocity_mps: float
) -> tuple[Samples, float] | None:
    """Insert zeros for the delay between transmission and start of the recording.

    Recorders differ in whether SlantRange includes the delay. The reading is selected by the time of the recording
    (range is half the sound speed times time), with a tolerance of 2 %. SoundVelocity is halved in XTF, but some
    recorders write the full value.

    Returns:
        Samples from the transmission on and the slant range of their end; None if neither reading agrees.
    """
    delay_s, duration_s = float(head.TimeDelay), float(head.TimeDuration)
    if not (math.isfinite(delay_s) and math.isfinite(duration_s) and 0 < delay_s <= 10 and 0 < duration_s <= 10):
        return None
    speed_mps = velocity_mps if 600 < velocity_mps < 1000 else velocity_mps / 2
    if not 600 < speed_mps < 1000:
        return None
    lead = round(delay_s / duration_s * samples.shape[0])
    if lead > samples.shape[0] * 4:
        return None
    total_m, recorded_m = speed_mps * (delay_s + duration_s), speed_mps * duration_s
    padded: Samples = np.concatenate([np.zeros(lead, samples.dtype), samples])
    if abs(slant_range_m - total_m) <= _DELAY_AGREEMENT * total_m:
        return padded, slant_range_m
    if abs(slant_range_m - recorded_m) <= _DELAY_AGREEMENT * recorded_m:
        return padded, slant_range_m * (delay_s + duration_s) / duration_s
    return None


def decode_text(raw: bytes) -> str:
    """Decode a fixed-width text field, padded with zeros or blanks, in any code page."""
    return "".join(c for c in raw.decode("latin-1") if c.isprintable()).strip()


def _frequency_hz(value_khz: float) -> float | None:
    """Return the frequency in hertz; the field is in kHz, but some recorders write hertz.

    Side-scan sonars use about 50 kHz to 3 MHz, so the unit is unambiguous.
    """
    if not math.isfinite(value_khz) or value_khz <= 0:
        return None
    return value_khz * 1000 if value_khz < 10_000 else value_khz
