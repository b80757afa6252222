"""Packets of XTF recordings: file header, sonar pings and attitude.

The structures are those of pyxtf. Its file reader is not used, because it does not validate the file. It does not
terminate on a record of length zero, and returns short sample arrays for a truncated packet. It selects the sample size
of a channel by position in the ping and not by channel number. It unpickles any `.pyxtf_idx` file beside the survey.

Field meanings are those of the XTF file format, revision 35 and later:

* A port channel is stored farthest sample first, so that port and starboard side by side form an image. It is
  reversed here: index 0 is nearest the vehicle on both sides.
* Speed is in knots, slant range in metres, frequency in kHz.
* Float samples (SampleFormat 5, IEEE) stay floats. A sample that is negative or not finite becomes 0.
* Ground-range samples (CorrectionFlags 2) are converted to equal steps of slant range with the altitude of the ping.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import takewhile
from typing import Final, TypeVar

import numpy as np
from pyxtf import XTFAttitudeData, XTFChanInfo, XTFFileHeader, XTFPingChanHeader, XTFPingHeader
from typing_extensions import override

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import slant_to_ground_range_m
from sonarpost.sonar.navigation import is_plausible
from sonarpost.sonar.readers.open_file import CheckedFile
from sonarpost.sonar.readers.records import Notes, RecordFormat
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Samples, Side

FILE_MAGIC: Final = 0x7B
SONAR_PACKET: Final = 0
ATTITUDE_PACKET: Final = 3
MAX_PACKET_BYTES: Final = 1 << 24
MAX_CHANNELS: Final = 64
HEADER_BYTES: Final = ctypes.sizeof(XTFFileHeader)

_START: Final = struct.Struct("<2sBBH4xI")
"""MagicNumber, HeaderType, SubChannelNumber, NumChansToFollow, NumBytesThisRecord."""
_ALIGNMENT_BYTES: Final = 64
"""Packets are padded to a multiple of this size."""
_CHAN_INFO_BYTES: Final = ctypes.sizeof(XTFChanInfo)
_CHAN_INFO_OFFSET: Final = 256
_PING_BYTES: Final = ctypes.sizeof(XTFPingHeader)
_PING_CHAN_BYTES: Final = ctypes.sizeof(XTFPingChanHeader)
_SIDES: Final = {1: Side.PORT, 2: Side.STARBOARD}
_CHANNEL_NAMES: Final = {0: "sub-bottom", 3: "bathymetry"}
_FORMAT_BYTES: Final = {2: 4, 3: 2, 5: 4, 8: 1}
"""SampleFormat of integers and IEEE floats, and their sizes; 0: the file is older than the field."""
_FLOAT: Final = 5
_MAX_FLOAT: Final = 1e12
"""Maximum of a float sample; a weight of up to 2^31 keeps it finite."""
_GROUND_RANGE: Final = 2
_MAX_WEIGHT: Final = 31
_DELAY_AGREEMENT: Final = 0.02
"""Maximum relative difference between slant range and time for a delayed recording."""
_USUAL_SHARE: Final = 0.02
"""Minimum share of the packets with a property of the file: fewer may be damaged packets."""
_FEW_PACKETS: Final = 8
"""From this number of packets on, a single one does not make a property of the file."""

KeyT = TypeVar("KeyT")


def usual(counts: Counter[KeyT], total: int | None = None) -> set[KeyT]:
    """Return the keys that more than a few packets have, of `total` or of those that are counted."""
    total = counts.total() if total is None else total
    least = max(_USUAL_SHARE * total, total >= _FEW_PACKETS)
    return {key for key, count in counts.items() if count > least}


class Numbering:
    """How the packets of a file number their channels: `observe` all sonar packets, then `conclude`.

    SubChannelNumber tells packets of two frequencies, or of two sides, apart. ChannelNumber may count from 0 in each
    subchannel: if it does, and the file header has a channel for each, these are in the order of the subchannels.
    """

    def __init__(self, channels: list[XTFChanInfo]) -> None:
        self.channels = channels
        self._side_scan = len(list(takewhile(lambda info: info.TypeOfChannel in _SIDES, channels)))
        self._counts: Counter[int] = Counter()
        self._ends: Counter[int] = Counter()
        self._subchannels = {0}
        self._stride = 0
        self._last_ping, self._repeated = -1, 0
        self.repeats_pings = False
        """Whether packets of one ping have the same PingNumber; else it counts packets, or each ping is one packet."""

    def observe(self, raw: bytes, head: XTFPingHeader) -> None:
        """Add a sonar packet with channels."""
        self._repeated += head.PingNumber == self._last_ping
        self._last_ping = head.PingNumber
        self._counts[raw[3]] += 1
        end = int.from_bytes(raw[_PING_BYTES : _PING_BYTES + 2], "little") + head.NumChansToFollow
        self._ends[end] += end <= MAX_CHANNELS

    def conclude(self) -> None:
        """Find the numbering; numbers of a few packets, which may be damaged, do not count."""
        self._subchannels = usual(self._counts) or {0}
        count, stride = len(self._subchannels), max(usual(self._ends), default=0)
        if 1 < count == max(self._subchannels) + 1 and count * stride == self._side_scan:
            self._stride = stride
        self.repeats_pings = self._repeated > _USUAL_SHARE * self._counts.total()

    def numbers(self, subchannel: int, number: int) -> tuple[int, int]:
        """Return the number of a channel in the file header, and its index among all channels of the file."""
        known = subchannel if subchannel in self._subchannels else min(self._subchannels)
        channel = known * self._stride + number
        return channel, known * MAX_CHANNELS + channel


def read_header(file: CheckedFile) -> tuple[XTFFileHeader, list[XTFChanInfo], int]:
    """Read the file header; return it with its channels and the offset of the first packet.

    Raises:
        SurveyFileError: Not an XTF file, truncated, or invalid channel counts.
    """
    if file.size_bytes < HEADER_BYTES:
        raise file.error("file size", file.size_bytes, f"at least {HEADER_BYTES} bytes")
    header = XTFFileHeader.from_buffer_copy(file.read_at(0, HEADER_BYTES, "file header"))
    if header.FileFormat != FILE_MAGIC:
        raise file.error("FileFormat", hex(header.FileFormat), hex(FILE_MAGIC))
    count = int(header.channel_count())
    if not 1 <= count <= MAX_CHANNELS or not header.NumberOfSonarChannels:
        sonar = int(header.NumberOfSonarChannels)
        expected = f"1 to {MAX_CHANNELS} channels, of side-scan sonar (recordings of a multibeam alone are not read)"
        raise file.error("channel counts", f"{sonar} sonar, {count - sonar} other", expected)
    # The header contains six channels; every further eight channels add 1024 bytes.
    extra = math.ceil(max(count - 6, 0) / 8)
    raw = file.read_at(0, HEADER_BYTES + 1024 * extra, "file header")
    offsets = range(_CHAN_INFO_OFFSET, _CHAN_INFO_OFFSET + (6 + 8 * extra) * _CHAN_INFO_BYTES, _CHAN_INFO_BYTES)
    return header, [XTFChanInfo.from_buffer_copy(raw, offset) for offset in offsets], len(raw)


def parse_attitude(raw: bytes) -> tuple[float, dict[str, float]] | None:
    """Parse an attitude packet: time in UTC seconds since 1970, angles in degrees by their names in `Ping`.

    Returns:
        None if it is too short, has no valid date or no valid angles.
    """
    if len(raw) < ctypes.sizeof(XTFAttitudeData):
        return None
    data = XTFAttitudeData.from_buffer_copy(raw)
    values = {"heading_deg": float(data.Heading), "pitch_deg": float(data.Pitch), "roll_deg": float(data.Roll)}
    try:
        when = datetime(data.Year, data.Month, data.Day, data.Hour, data.Minute, data.Second, tzinfo=UTC)
    except ValueError:
        return None
    if values["heading_deg"] == 360 or not all(is_plausible(name, value) for name, value in values.items()):
        return None
    return when.timestamp() + float(data.Millisecond) / 1000, values


class PacketParser(RecordFormat):
    """Layout of the packets, and parser of those of the sonar; `notes` counts skipped and corrected data."""

    name = "packet"
    magic = b"\xce\xfa"
    head_bytes = _START.size

    def __init__(self, file: CheckedFile, numbering: Numbering, notes: Notes, *, port_farthest_first: bool) -> None:
        self._file = file
        self._channels = numbering.channels
        self._numbering = numbering
        self._notes = notes
        self._reverse = {Side.PORT: port_farthest_first, Side.STARBOARD: False}

    @override
    def length(self, head: bytes, offset: int) -> int:
        """Return NumBytesThisRecord; 0 if it, or NumChansToFollow of a sonar packet, is not possible."""
        magic, kind, _, channels, length = _START.unpack(head)
        least = self.head_bytes
        if kind == SONAR_PACKET:
            least = _PING_BYTES + channels * _PING_CHAN_BYTES if channels <= MAX_CHANNELS else MAX_PACKET_BYTES + 1
        return length if magic == self.magic and least <= length <= MAX_PACKET_BYTES else 0

    @override
    def is_proved(self, raw: bytes) -> bool:
        """Return whether a packet is a sonar ping with a valid date, filled by its channels up to the padding."""
        if raw[2] != SONAR_PACKET:
            return False
        try:
            head, _ = self.header(raw, "")
            filled = sum(_PING_CHAN_BYTES + len(content) for *_, content in self._stored(raw, head, ""))
        except SurveyFileError:
            return False
        return len(raw) - _PING_BYTES - filled < _ALIGNMENT_BYTES

    def header(self, raw: bytes, place: str) -> tuple[XTFPingHeader, float]:
        """Parse the header of a ping and its time, UTC seconds since 1970; HSeconds of 100 is the next second.

        Raises:
            SurveyFileError: The packet has no valid date.
        """
        head = XTFPingHeader.from_buffer_copy(raw)
        where = f"ping {head.PingNumber}, {place}"
        stamp = (head.Year, head.Month, head.Day, head.Hour, head.Minute, head.Second)
        expected = "a UTC date and time, hundredths 0 to 100"
        if head.HSeconds > 100:
            raise self._file.error(f"{where}, HSeconds", head.HSeconds, expected)
        try:
            whole = datetime(*stamp, tzinfo=UTC)
        except ValueError as error:
            raise self._file.error(f"{where}, date and time", stamp, expected) from error
        return head, whole.timestamp() + float(head.HSeconds) / 100

    def channels(self, raw: bytes, head: XTFPingHeader, place: str) -> Iterator[ChannelPing]:
        """Yield the side-scan channels of a ping.

        Raises:
            SurveyFileError: A channel exceeds the packet, or its samples have another format.
        """
        for channel_head, info, index, content in self._stored(raw, head, place):
            channel = self._channel_ping(channel_head, info, content, head, index)
            if channel is not None:
                yield channel

    def _stored(
        self, raw: bytes, head: XTFPingHeader, place: str
    ) -> Iterator[tuple[XTFPingChanHeader, XTFChanInfo, int, bytes]]:
        """Yield header, description, index and samples of each channel of a ping."""
        where = f"ping {head.PingNumber}, {place}"
        count = int(head.NumChansToFollow)
        offset = _PING_BYTES
        for _ in range(count):
            if offset + _PING_CHAN_BYTES > len(raw):
                raise self._file.error(f"{where}, NumChansToFollow", count, "as many channels as the record holds")
            channel_head = XTFPingChanHeader.from_buffer_copy(raw, offset)
            offset += _PING_CHAN_BYTES
            number, index = self._numbering.numbers(raw[3], int(channel_head.ChannelNumber))
            if number >= len(self._channels):
                raise self._file.error(f"{where}, ChannelNumber", number, f"0 to {len(self._channels) - 1}")
            info = self._channels[number]
            bytes_per_sample = self._sample_bytes(info, number)
            samples = int(channel_head.NumSamples) or int(info.Reserved)  # older files: in the header
            end = offset + samples * bytes_per_sample
            if end > len(raw):
                limit = (len(raw) - offset) // bytes_per_sample
                raise self._file.error(f"{where}, channel {number}, NumSamples", samples, f"at most {limit}")
            yield channel_head, info, index, raw[offset:end]
            offset = end

    def _sample_bytes(self, info: XTFChanInfo, number: int) -> int:
        size = int(info.BytesPerSample)
        if size not in _FORMAT_BYTES.values():
            raise self._file.error(f"channel {number}, BytesPerSample", size, "1, 2 or 4")
        # Other channels than side-scan are skipped.
        if info.TypeOfChannel in _SIDES and info.SampleFormat and _FORMAT_BYTES.get(info.SampleFormat) != size:
            expected = f"0, or the unsigned integer or IEEE float of {size} bytes"
            raise self._file.error(f"channel {number}, SampleFormat", info.SampleFormat, expected)
        return size

    def _channel_ping(
        self, head: XTFPingChanHeader, info: XTFChanInfo, raw: bytes, ping: XTFPingHeader, index: int
    ) -> ChannelPing | None:
        side = _SIDES.get(info.TypeOfChannel)
        if side is None:
            name = _CHANNEL_NAMES.get(info.TypeOfChannel, f"type {info.TypeOfChannel}")
            self._notes.add(f"skipped channel: {name}, not side-scan")
            return None
        slant_range_m = float(head.SlantRange)
        if not raw or not 0 < slant_range_m <= MAX_SLANT_RANGE_M:  # includes NaN
            self._notes.add(f"skipped {side.value} channel: no samples or no slant range")
            return None
        samples = self._samples(raw, info, reverse=self._reverse[side])
        if info.CorrectionFlags == _GROUND_RANGE:
            projected = _at_slant_ranges(samples, slant_range_m, head, float(ping.SensorPrimaryAltitude))
            if projected is None:
                self._notes.add(f"skipped {side.value} channel: ground-range samples without a plausible altitude")
                return None
            self._notes.add("ground-range samples converted to slant range with the altitude")
            samples, slant_range_m = projected
        elif head.TimeDelay:
            delayed = _with_delay(samples, slant_range_m, head, float(ping.SoundVelocity))
            if delayed is None:
                self._notes.add(f"skipped {side.value} channel: TimeDelay, SlantRange and TimeDuration disagree")
                return None
            self._notes.add("recording began after the transmission (TimeDelay): zeros replace the missing samples")
            samples, slant_range_m = delayed
        return ChannelPing(
            side=side,
            samples=samples,
            slant_range_m=slant_range_m,
            frequency_hz=_frequency_hz(float(head.Frequency) or info.Frequency),
            scale=self._scale(int(head.Weight)),
            index=index,
        )

    def _samples(self, raw: bytes, info: XTFChanInfo, *, reverse: bool) -> Samples:
        """Return little-endian samples in native byte order, reversed if requested."""
        kind = "f" if info.SampleFormat == _FLOAT else "u"
        stored = np.frombuffer(raw, dtype=f"<{kind}{info.BytesPerSample}")[:: -1 if reverse else 1]
        samples: Samples = stored.astype(f"{kind}{info.BytesPerSample}")  # a copy in any case
        if kind == "f":
            valid = (samples >= 0) & (samples <= _MAX_FLOAT)  # excludes NaN
            if not valid.all():
                self._notes.add(f"samples that are negative, not finite or above {_MAX_FLOAT:g} are read as 0")
                samples[~valid] = 0
        return samples

    def _scale(self, weight: int) -> float:
        """Return the scale of a weight N: echo strength is the sample times 2^-N."""
        if not -_MAX_WEIGHT <= weight <= _MAX_WEIGHT:
            self._notes.add(f"sample weight beyond ±{_MAX_WEIGHT} is not applied")
            return 1.0
        return math.ldexp(1.0, -weight)


def _at_slant_ranges(
    samples: Samples, slant_range_m: float, head: XTFPingChanHeader, altitude_m: float
) -> tuple[Samples, float] | None:
    """Convert samples in equal steps of ground range to the same number of equal steps of slant range.

    A new sample is the one that contains its ground range, so that no new values arise; 0 in the water column.

    Returns:
        Samples and the slant range of their end; None if altitude or ranges are implausible.
    """
    if not is_plausible("altitude_m", altitude_m) or altitude_m == 0:
        return None
    ground_range_m = float(head.GroundRange)
    if not 0 < ground_range_m <= MAX_SLANT_RANGE_M:  # includes NaN
        ground_range_m = float(slant_to_ground_range_m(slant_range_m, altitude_m))
    if not ground_range_m > 0:  # includes NaN
        return None
    count = samples.shape[0]
    far_m = math.hypot(ground_range_m, altitude_m)
    ground_m = slant_to_ground_range_m((np.arange(count) + 0.5) * (far_m / count), altitude_m)
    on_bottom = np.isfinite(ground_m)
    indices = np.minimum(ground_m[on_bottom] * (count / ground_range_m), count - 1).astype(np.intp)
    projected = np.zeros_like(samples)
    projected[on_bottom] = samples[indices]
    return projected, far_m


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


def _frequency_hz(value_khz: float) -> float | None:
    """Return the frequency in hertz; the field is in kHz, but some recorders write hertz.

    Side-scan sonars use about 50 kHz to 3 MHz, so the unit is unambiguous.
    """
    if not math.isfinite(value_khz) or value_khz <= 0:
        return None
    return value_khz * 1000 if value_khz < 10_000 else value_khz
