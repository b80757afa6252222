"""Writer of XTF recordings, for the simulator, for parts of surveys and for tests with other readers."""

import ctypes
import math
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import numpy as np
from pyxtf import XTFFileHeader, XTFPingChanHeader, XTFPingHeader

from sonarpost.errors import SurveyFileError
from sonarpost.files import write_atomically
from sonarpost.sonar.geometry import Position
from sonarpost.sonar.navigation import KNOT_MPS
from sonarpost.sonar.projection import Projection
from sonarpost.sonar.readers.xtf_navigation import NAV_UNITS_DEGREES, NAV_UNITS_METRES
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_CHANNEL_TYPE: Final = {Side.PORT: 1, Side.STARBOARD: 2}
_SAMPLE_FORMAT: Final = {"uint8": 8, "uint16": 3, "uint32": 2, "float32": 5}
_SONAR_NAME_BYTES: Final = 15
_MAX_CHANNELS: Final = 6
_SOUND_SPEED_MPS: Final = 1500.0
_ALIGNMENT_BYTES: Final = 64

_Slot = tuple[Side, int]
"""A channel of the file: a side, and the number of the channel on that side of a ping."""


def write_xtf(survey: Survey, path: Path, projected_crs: str | None = None) -> None:
    """Write a survey as XTF, atomically.

    Samples keep their type (integers of 8, 16 or 32 bits, or floats). Time is rounded to 10 ms, the resolution of the
    format; altitude, depth, heading, attitude and speed to 32-bit floats. XTF has no code for an unknown value: None is
    written as zero, which the reader takes as None for a position, an altitude, or a field that is zero in every ping.
    For the same reason a heading of exactly 0 degrees is written as 360. The same survey gives the same bytes.

    Args:
        survey: The survey.
        path: The file to create or replace.
        projected_crs: Write positions in the unit of this coordinate system, which the file does not name. None for
            degrees.

    Raises:
        ValueError: Not a projected coordinate system.
        SurveyFileError: The format cannot represent the survey (more than six channels, a channel whose sample
            size changes, a sonar name over 15 ASCII characters, or a value out of range).
        OSError: The file cannot be written.
    """
    slots = _slots(survey, path)
    header = _file_header(survey, slots, path)
    if projected_crs is not None:
        header.NavUnits = NAV_UNITS_METRES
        projection = Projection(projected_crs)
        survey = replace(survey, pings=tuple(_projected(ping, projection) for ping in survey.pings))
    chunks = [bytes(header)]
    for row, ping in enumerate(survey.pings):
        chunks.append(_packet(ping, row, slots, path))
    write_atomically(path, b"".join(chunks))


def _projected(ping: Ping, projection: Projection) -> Ping:
    """Return the ping with northing and easting in the fields of latitude and longitude."""
    if ping.lat_deg is None or ping.lon_deg is None:
        return ping
    easting_m, northing_m = projection.coordinates(Position(ping.lat_deg, ping.lon_deg))
    return replace(ping, lat_deg=northing_m / projection.unit_m, lon_deg=easting_m / projection.unit_m)


def _slots(survey: Survey, path: Path) -> dict[_Slot, ChannelPing]:
    """Return the channels of the file in their order, each with its first occurrence in a ping."""
    found: dict[_Slot, ChannelPing] = {}
    for row, ping in enumerate(survey.pings):
        for slot, channel in _numbered(ping):
            known = found.setdefault(slot, channel)
            if known.samples.dtype != channel.samples.dtype:
                raise _refuse(path, row, "sample type", channel.samples.dtype, f"{known.samples.dtype} throughout")
            if channel.samples.dtype.name not in _SAMPLE_FORMAT:
                raise _refuse(path, row, "sample type", channel.samples.dtype, ", ".join(_SAMPLE_FORMAT))
    if not 1 <= len(found) <= _MAX_CHANNELS:
        raise SurveyFileError(str(path), "channels", len(found), f"1 to {_MAX_CHANNELS}")
    order = list(Side)
    return dict(sorted(found.items(), key=lambda item: (item[0][1], order.index(item[0][0]))))


def _numbered(ping: Ping) -> list[tuple[_Slot, ChannelPing]]:
    seen: Counter[Side] = Counter()
    numbered: list[tuple[_Slot, ChannelPing]] = []
    for channel in ping.channels:
        numbered.append(((channel.side, seen[channel.side]), channel))
        seen[channel.side] += 1
    return numbered


def _file_header(survey: Survey, slots: dict[_Slot, ChannelPing], path: Path) -> XTFFileHeader:
    if not survey.sonar_id.isascii() or len(survey.sonar_id) > _SONAR_NAME_BYTES:
        expected = f"at most {_SONAR_NAME_BYTES} ASCII characters"
        raise SurveyFileError(str(path), "sonar_id", survey.sonar_id, expected)
    header = XTFFileHeader()
    header.RecordingProgramName = b"snrpost"  # the field has eight bytes, the last of them zero
    header.RecordingProgramVersion = b"1"
    header.SonarName = b"" if survey.sonar_id == "unknown" else survey.sonar_id.encode("ascii")
    header.ThisFileName = path.name.encode("ascii", "replace")[:63]
    header.NavUnits = NAV_UNITS_DEGREES
    header.NumberOfSonarChannels = len(slots)
    for number, ((side, ordinal), channel) in enumerate(slots.items()):
        info = header.ChanInfo[number]
        info.TypeOfChannel = _CHANNEL_TYPE[side]
        info.SubChannelNumber = number
        info.CorrectionFlags = 1  # slant range
        info.UniPolar = 1
        info.BytesPerSample = channel.samples.dtype.itemsize
        info.SampleFormat = _SAMPLE_FORMAT[channel.samples.dtype.name]
        info.ChannelName = f"{side.name}{ordinal or ''}".encode("ascii")
        info.VoltScale = 5.0
        info.Frequency = (channel.frequency_hz or 0.0) / 1000
        info.BeamsPerArray = 1
    return header


def _packet(ping: Ping, row: int, slots: dict[_Slot, ChannelPing], path: Path) -> bytes:
    numbers = {slot: number for number, slot in enumerate(slots)}
    bodies: list[bytes] = []
    for slot, channel in _numbered(ping):
        bodies += [bytes(_channel_header(channel, numbers[slot], row, path)), _stored_samples(channel)]
    body = b"".join(bodies)
    length = ctypes.sizeof(XTFPingHeader) + len(body)
    padding = -length % _ALIGNMENT_BYTES
    head = _ping_header(ping, row, path)
    head.NumChansToFollow = len(ping.channels)
    head.NumBytesThisRecord = length + padding
    return bytes(head) + body + bytes(padding)


def _stored_samples(channel: ChannelPing) -> bytes:
    """Return the samples little-endian, port farthest first as the format requires."""
    ordered = channel.samples[::-1] if channel.side is Side.PORT else channel.samples
    return ordered.astype(ordered.dtype.newbyteorder("<")).tobytes()


def _channel_header(channel: ChannelPing, number: int, row: int, path: Path) -> XTFPingChanHeader:
    slant_range_m = channel.slant_range_m
    if not math.isfinite(slant_range_m) or slant_range_m <= 0:
        raise _refuse(path, row, "slant_range_m", slant_range_m, "a finite range above 0")
    if channel.samples.ndim != 1 or channel.samples.shape[0] == 0:
        raise _refuse(path, row, "samples", channel.samples.shape, "one dimension, at least one sample")
    head = XTFPingChanHeader()
    head.ChannelNumber = number
    head.SlantRange = slant_range_m
    head.TimeDuration = 2 * slant_range_m / _SOUND_SPEED_MPS
    frequency_khz = (channel.frequency_hz or 0.0) / 1000
    # The field of the ping is an integer in kHz; other frequencies are in the file header only.
    if frequency_khz == round(frequency_khz) and 0 < frequency_khz < 10_000:
        head.Frequency = round(frequency_khz)
    head.NumSamples = channel.samples.shape[0]
    return head


def _ping_header(ping: Ping, row: int, path: Path) -> XTFPingHeader:
    head = XTFPingHeader()
    head.HeaderType = 0
    if not 0 <= ping.number < 2**32:
        raise _refuse(path, row, "number", ping.number, "0 to 4294967295")
    head.PingNumber = ping.number
    _set_time(head, ping, row, path)
    # Two-way travel: the sound velocity of the format is halved.
    head.SoundVelocity = _SOUND_SPEED_MPS / 2
    values = {
        "SensorYcoordinate": ping.lat_deg,
        "SensorXcoordinate": ping.lon_deg,
        "SensorHeading": 360.0 if ping.heading_deg == 0 else ping.heading_deg,
        "SensorPrimaryAltitude": ping.altitude_m,
        "SensorDepth": ping.depth_m,
        "SensorSpeed": None if ping.speed_mps is None else ping.speed_mps / KNOT_MPS,
        "SensorPitch": ping.pitch_deg,
        "SensorRoll": ping.roll_deg,
    }
    for name, value in values.items():
        if value is not None and not (math.isfinite(value) and abs(value) < np.finfo(np.float32).max):
            raise _refuse(path, row, name, value, "a finite number")
        setattr(head, name, value or 0.0)
    head.ShipYcoordinate = head.SensorYcoordinate
    head.ShipXcoordinate = head.SensorXcoordinate
    head.ShipGyro = head.SensorHeading
    head.ShipSpeed = head.SensorSpeed
    return head


def _set_time(head: XTFPingHeader, ping: Ping, row: int, path: Path) -> None:
    try:
        hundredths = round(ping.time_utc_s * 100)
        stamp = _EPOCH + timedelta(milliseconds=hundredths * 10)
    except (OverflowError, ValueError) as error:
        raise _refuse(path, row, "time_utc_s", ping.time_utc_s, "seconds since 1970, years 1 to 9999") from error
    head.Year, head.Month, head.Day = stamp.year, stamp.month, stamp.day
    head.Hour, head.Minute, head.Second = stamp.hour, stamp.minute, stamp.second
    head.HSeconds = stamp.microsecond // 10_000
    head.JulianDay = stamp.timetuple().tm_yday
    head.FixTimeHour, head.FixTimeMinute, head.FixTimeSecond = stamp.hour, stamp.minute, stamp.second
    head.FixTimeHsecond = head.HSeconds


def _refuse(path: Path, row: int, field: str, value: object, expected: str) -> SurveyFileError:
    return SurveyFileError(str(path), f"ping in row {row}, {field}", value, expected)
