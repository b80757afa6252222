"""Reader of XTF (eXtended Triton Format) side-scan recordings, ping by ping.

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
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pyxtf import XTFAttitudeData, XTFChanInfo, XTFFileHeader, XTFPacketStart, XTFPingChanHeader, XTFPingHeader

from sonarpost.sonar.geometry import Position, slant_to_ground_range_m
from sonarpost.sonar.navigation import (
    KNOT_MPS,
    NAVIGATION_LIMITS,
    PingCounter,
    is_plausible,
    position_in_degrees,
)
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.projection import GridExtent, Projection, extended, grid_coordinates
from sonarpost.sonar.readers.open_file import CheckedFile, SequentialReader
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Samples, Side

FILE_MAGIC: Final = 0x7B
PACKET_MAGIC: Final = 0xFACE
_MAGIC_BYTES: Final = PACKET_MAGIC.to_bytes(2, "little")
SONAR_PACKET: Final = 0
ATTITUDE_PACKET: Final = 3
NAV_UNITS_METRES: Final = 0
NAV_UNITS_DEGREES: Final = 3
MAX_PACKET_BYTES: Final = 1 << 24
MAX_CHANNELS: Final = 64
HEADER_BYTES: Final = ctypes.sizeof(XTFFileHeader)

_START_BYTES: Final = ctypes.sizeof(XTFPacketStart)
_ATTITUDE_VALID_S: Final = 1.0
"""An attitude packet is valid for the pings of this time after it."""
_ATTITUDE_FIELDS: Final = ("heading_deg", "pitch_deg", "roll_deg")
_PROFILE_COLUMNS: Final = 32
_PROFILE_PINGS: Final = 64
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
        sonar = int(header.NumberOfSonarChannels)
        expected = f"1 to {MAX_CHANNELS} channels, of side-scan sonar (recordings of a multibeam alone are not read)"
        raise file.error("channel counts", f"{sonar} sonar, {count - sonar} other", expected)
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
            channel = self._channel_ping(channel_head, info, raw[offset:end], head)
            offset = end
            if channel is not None:
                yield channel

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
        self, head: XTFPingChanHeader, info: XTFChanInfo, raw: bytes, ping: XTFPingHeader
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
        samples = self._samples(raw, info, reverse=self._reverse[side])
        if info.CorrectionFlags == _GROUND_RANGE:
            projected = _at_slant_ranges(samples, slant_range_m, head, float(ping.SensorPrimaryAltitude))
            if projected is None:
                self.notes[f"skipped {side.value} channel: ground-range samples without a plausible altitude"] += 1
                return None
            self.notes["ground-range samples converted to slant range with the altitude"] += 1
            samples, slant_range_m = projected
        elif head.TimeDelay:
            delayed = _with_delay(samples, slant_range_m, head, float(ping.SoundVelocity))
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

    def _samples(self, raw: bytes, info: XTFChanInfo, *, reverse: bool) -> Samples:
        """Return little-endian samples in native byte order, reversed if requested."""
        kind = "f" if info.SampleFormat == _FLOAT else "u"
        stored = np.frombuffer(raw, dtype=f"<{kind}{info.BytesPerSample}")[:: -1 if reverse else 1]
        samples: Samples = stored.astype(f"{kind}{info.BytesPerSample}")  # a copy in any case
        if kind == "f":
            valid = (samples >= 0) & (samples <= _MAX_FLOAT)  # excludes NaN
            if not valid.all():
                self.notes[f"samples that are negative, not finite or above {_MAX_FLOAT:g} are read as 0"] += 1
                samples[~valid] = 0
        return samples

    def _scale(self, weight: int) -> float:
        """Return the scale of a weight N: echo strength is the sample times 2^-N."""
        if not -_MAX_WEIGHT <= weight <= _MAX_WEIGHT:
            self.notes[f"sample weight beyond ±{_MAX_WEIGHT} is not applied"] += 1
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


class XtfSource(StreamedSource):
    """An open XTF recording.

    A file that ends inside its last packet, as after a power failure, is read up to there with a warning. The cut
    packet may not be longer than the longest one before it: a damaged length in the middle of a file is an error.

    A field that is zero in every ping is unknown. HSeconds of 100 (rounding of a recorder) is read as the next second.
    Pitch, roll and heading that no ping contains are taken from attitude packets up to one second before the ping.

    Raises:
        SurveyFileError: Not an XTF file, damaged, inconsistent, without a complete sonar ping, or unreadable.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._file = CheckedFile(path)
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def _open(self) -> None:
        if self._file.size_bytes < HEADER_BYTES:
            raise self._file.error("file size", self._file.size_bytes, f"at least {HEADER_BYTES} bytes")
        reader = SequentialReader(self._file)
        header, channels = read_header(reader, self._file)
        self._first_packet = reader.offset
        crs = self.options.projected_crs
        nav_units = int(header.NavUnits)
        projection = Projection(crs) if crs is not None and nav_units == NAV_UNITS_METRES else None
        self._cleaner = NavigationCleaner(nav_units, projection)
        farthest_first = self.options.port_order == "farthest_first"
        self._parser = PingParser(self._file, channels, port_farthest_first=farthest_first)
        self._port_order = _PortOrderCheck()
        self._attitudes = 0
        self._attitude_fields: set[str] = set()
        self._pings = 0
        self._cut = ""
        self._only_other_position = 0
        self._validate(decode_text(header.SonarName) or "unknown", self.path.stem)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _format_warnings(self) -> list[str]:
        warnings = [f"{text} ({count} times)" for text, count in sorted(self._parser.notes.items())]
        if self._attitudes and self._from_attitude():
            names = ", ".join(self._from_attitude())
            warnings.append(f"{names} from attitude packets ({self._attitudes} of them)")
        if self._only_other_position > self._pings / 2:
            used, other = ("ship", "sensor") if self.options.position_source == "ship" else ("sensor", "ship")
            warnings.append(f'the file has the position of the {other}, not of the {used}: position_source = "{other}"')
        cut = [self._cut] if self._cut else []
        return [*cut, *warnings, *self._cleaner.warnings(self._pings), *self._port_order.warnings()]

    def _grid(self) -> GridExtent | None:
        return self._cleaner.grid

    def _from_attitude(self) -> tuple[str, ...]:
        """Return the fields taken from attitude packets: zero in every ping, and set in a packet."""
        return tuple(name for name in sorted(self._attitude_fields) if name not in self._cleaner.recorded)

    def _read_pings(self, *, first_pass: bool) -> Iterator[Ping]:
        attitude: Attitude | None = None
        row = 0
        for kind, place, raw in self._packets():
            if kind == ATTITUDE_PACKET and (parsed := parse_attitude(raw)) is not None:
                attitude = parsed
                if first_pass:
                    self._attitudes += 1
                    self._attitude_fields.update(name for name in _ATTITUDE_FIELDS if getattr(parsed, name))
            elif kind == SONAR_PACKET:
                yield self._ping(raw, place, attitude, row if first_pass else None)
                row += 1
            elif first_pass:
                self._parser.notes[f"skipped packet of type {kind}: not a sonar ping"] += 1
        self._pings = row
        self._file.check_unchanged()

    def _packets(self) -> Iterator[tuple[int, str, bytes]]:
        """Yield (type, place in the file, bytes of the whole record) of each complete packet."""
        reader = SequentialReader(self._file, self._first_packet)
        longest = 0
        while remaining := reader.remaining:
            place = f"packet at byte {reader.offset}"
            raw = reader.read(min(_START_BYTES, remaining), place)
            if raw[:2] != _MAGIC_BYTES[: len(raw)]:
                found = hex(int.from_bytes(raw[:2], "little"))
                raise self._file.error(f"{place}, MagicNumber", found, hex(PACKET_MAGIC))
            start = XTFPacketStart.from_buffer_copy(raw.ljust(_START_BYTES, b"\0"))
            length = int(start.NumBytesThisRecord) if remaining >= _START_BYTES else _START_BYTES
            if not _START_BYTES <= length <= MAX_PACKET_BYTES:
                expected = f"{_START_BYTES} to {MAX_PACKET_BYTES} bytes"
                raise self._file.error(f"{place}, NumBytesThisRecord", length, expected)
            if remaining < length <= longest:
                self._cut = (
                    f"the file ends inside its last packet, as after a power failure: {remaining} bytes are left out"
                )
                return
            longest = max(longest, length)
            yield int(start.HeaderType), place, raw + reader.read(length - len(raw), place)

    def _ping(self, raw: bytes, place: str, attitude: Attitude | None, row: int | None) -> Ping:
        """Return a ping; `row` is its row in the first pass, else None."""
        header, time_utc_s = self._parser.header(raw, place)
        sensor = (float(header.SensorXcoordinate), float(header.SensorYcoordinate))
        ship = (float(header.ShipXcoordinate), float(header.ShipYcoordinate))
        used, other = (ship, sensor) if self.options.position_source == "ship" else (sensor, ship)
        stored = Ping(
            number=int(header.PingNumber),
            time_utc_s=time_utc_s,
            channels=tuple(self._parser.channels(raw, header, place)),
            lat_deg=used[1],
            lon_deg=used[0],
            heading_deg=float(header.SensorHeading),
            altitude_m=float(header.SensorPrimaryAltitude),
            depth_m=float(header.SensorDepth),
            speed_mps=float(header.SensorSpeed) * KNOT_MPS,
            pitch_deg=float(header.SensorPitch),
            roll_deg=float(header.SensorRoll),
        )
        if row is not None:
            self._cleaner.observe(row, stored)
            self._port_order.observe(stored.channels)
            self._only_other_position += used == (0.0, 0.0) != other
        ping = self._cleaner.clean(stored)
        if attitude is not None and 0 <= time_utc_s - attitude.time_utc_s <= _ATTITUDE_VALID_S:
            ping = replace(ping, **{name: getattr(attitude, name) for name in self._from_attitude()})
        return ping


class _PortOrderCheck:
    """Detects port samples stored in the opposite order to the assumed one.

    Both sides record the same water column and similar seabed, so their mean profiles correlate if both begin at the
    vehicle. The check only gives a warning.
    """

    def __init__(self) -> None:
        self._sums = {side: np.zeros(_PROFILE_COLUMNS) for side in Side}
        self._counts = dict.fromkeys(Side, 0)

    def observe(self, channels: tuple[ChannelPing, ...]) -> None:
        """Add the first channel of each side to its profile."""
        added: set[Side] = set()
        for channel in channels:
            per_column = channel.samples.shape[0] // _PROFILE_COLUMNS
            if channel.side in added or per_column < 2:
                continue
            added.add(channel.side)
            columns = channel.samples[: per_column * _PROFILE_COLUMNS].reshape(_PROFILE_COLUMNS, per_column)
            self._sums[channel.side] += columns.mean(axis=1)
            self._counts[channel.side] += 1

    def warnings(self) -> list[str]:
        """Return the warning, if the order seems wrong."""
        if min(self._counts.values()) < _PROFILE_PINGS:
            return []
        port, starboard = (self._profile(side) for side in Side)
        scale = float(np.linalg.norm(port) * np.linalg.norm(starboard))
        if scale == 0 or float(port[::-1] @ starboard) < 0.5 * scale or float(port @ starboard) > 0:
            return []
        return ['port looks stored nearest sample first, against the format: port_order = "nearest_first" mirrors it']

    def _profile(self, side: Side) -> npt.NDArray[np.float64]:
        profile: npt.NDArray[np.float64] = np.log1p(self._sums[side] / self._counts[side])
        profile -= profile.mean()
        return profile


class NavigationCleaner:
    """Replaces unknown and implausible navigation values by None.

    The pings are given as stored in the file: `lat_deg` and `lon_deg` hold the Y and X coordinate in the unit of the
    file, and unknown values are zero.

    These are None: a position that is 0/0, not finite or out of range; a position in metres without a projection; an
    altitude of 0; a field that is zero in every ping; all fields of a ping whose navigation is all zero; a value
    outside `NAVIGATION_LIMITS`.

    Args:
        nav_units: NavUnits of the file header: 3 is degrees, 0 projected metres. The values are not used to guess it.
        projection: Projection of coordinates in metres, if known.
    """

    def __init__(self, nav_units: int, projection: Projection | None) -> None:
        self._nav_units = nav_units
        self._projection = projection
        self.recorded: set[str] = set()
        """Fields that are not zero in a ping observed so far."""
        self.grid: GridExtent | None = None
        """Extent of the coordinates, if they are in metres."""
        self._without_fix = PingCounter()
        self._implausible: dict[str, PingCounter] = {}

    def observe(self, row: int, stored: Ping) -> None:
        """Count irregularities of a ping in the first pass through the file."""
        if self._position(stored) is None:
            self._without_fix.add(row)
        if self._nav_units == NAV_UNITS_METRES and stored.lat_deg is not None and stored.lon_deg is not None:
            self.grid = extended(self.grid, stored.lon_deg, stored.lat_deg)
        for name in NAVIGATION_LIMITS:
            value = getattr(stored, name)
            if value:
                self.recorded.add(name)
                if not is_plausible(name, value):
                    self._implausible.setdefault(name, PingCounter()).add(row)

    def clean(self, stored: Ping) -> Ping:
        """Return the ping with its position in degrees, and None for unknown and implausible values."""
        values: dict[str, Any] = {name: getattr(stored, name) for name in NAVIGATION_LIMITS}
        empty = not any((stored.lat_deg, stored.lon_deg, *values.values()))  # the recorder had no navigation yet
        for name, value in values.items():
            unknown = empty or name not in self.recorded or (name == "altitude_m" and value == 0)
            if unknown or value is None or not is_plausible(name, value):
                values[name] = None
        if values["heading_deg"] == 360.0:
            values["heading_deg"] = 0.0
        position = self._position(stored)
        lat_deg, lon_deg = (None, None) if position is None else (position.lat_deg, position.lon_deg)
        grid_m = None
        if self._nav_units == NAV_UNITS_METRES and stored.lat_deg is not None and stored.lon_deg is not None:
            grid_m = grid_coordinates(stored.lon_deg, stored.lat_deg)
        return replace(stored, lat_deg=lat_deg, lon_deg=lon_deg, grid_m=grid_m, **values)

    def warnings(self, total: int) -> list[str]:
        """Return one line for each kind of irregularity in `total` pings."""
        warnings: list[str] = []
        if self._nav_units == NAV_UNITS_METRES and self._projection is None:
            warnings.append(
                "no positions: NavUnits is 0 (projected metres) and the file does not contain the projection; "
                "set the option projected_crs (--crs)"
            )
        elif self._nav_units not in (NAV_UNITS_DEGREES, NAV_UNITS_METRES):
            expected = f"{NAV_UNITS_DEGREES} (degrees) or {NAV_UNITS_METRES} (projected metres)"
            warnings.append(f"no positions: NavUnits is {self._nav_units}, expected {expected}")
        elif self._without_fix.count:
            warnings.append(f"no position fix in {self._without_fix.summary(total)}")
        implausible = sorted(self._implausible.items())
        return warnings + [f"{name} out of range in {counter.summary(total)}" for name, counter in implausible]

    def _position(self, stored: Ping) -> Position | None:
        if stored.lat_deg is None or stored.lon_deg is None:
            return None
        if self._nav_units == NAV_UNITS_METRES and self._projection is not None:
            return self._projection.position(stored.lon_deg, stored.lat_deg)
        return position_in_degrees(stored.lat_deg, stored.lon_deg) if self._nav_units == NAV_UNITS_DEGREES else None
