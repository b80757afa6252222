"""Reader of XTF (eXtended Triton Format) side-scan recordings.

The structures are pyxtf's. The walk from packet to packet is our own, because pyxtf's trusts the file: it loops for
ever on a record of length zero, returns short sample arrays from a truncated packet, takes a channel's sample size
from its place in the ping and not from its number, and unpickles any `.pyxtf_idx` file lying beside the survey.

Field meanings are those of the XTF file format, revision 35 and later. Two conventions matter most:

* A port channel is stored farthest sample first, so that port and starboard side by side make a picture. It is
  turned round here: index 0 is nearest the vehicle on both sides.
* Speed is in knots, slant range in metres, frequency in kHz.
"""

from __future__ import annotations

import ctypes
import math
import os
import stat
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np
from pyxtf import XTFChanInfo, XTFFileHeader, XTFPacketStart, XTFPingChanHeader, XTFPingHeader

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.survey import ChannelPing, Ping, Samples, Side, Survey
from sonarpost.sonar.xtf_navigation import NavigationRecord, clean_navigation

FILE_MAGIC: Final = 0x7B
PACKET_MAGIC: Final = 0xFACE
SONAR_PACKET: Final = 0
MAX_FILE_BYTES: Final = 1 << 30
"""A survey is held in memory; a larger file is not one of about 1000 pings."""
MAX_PACKET_BYTES: Final = 1 << 24
MAX_CHANNELS: Final = 64

_HEADER_BYTES: Final = ctypes.sizeof(XTFFileHeader)
_CHAN_INFO_BYTES: Final = ctypes.sizeof(XTFChanInfo)
_CHAN_INFO_OFFSET: Final = 256
_START_BYTES: Final = ctypes.sizeof(XTFPacketStart)
_PING_BYTES: Final = ctypes.sizeof(XTFPingHeader)
_PING_CHAN_BYTES: Final = ctypes.sizeof(XTFPingChanHeader)
_SIDES: Final = {1: Side.PORT, 2: Side.STARBOARD}
_CHANNEL_NAMES: Final = {0: "sub-bottom", 3: "bathymetry"}
_SAMPLE_BYTES: Final = (1, 2, 4)
_FORMAT_BYTES: Final = {2: 4, 3: 2, 8: 1}
"""SampleFormat of the integer encodings and their sizes; 0 is a file older than the field."""
_GROUND_RANGE: Final = 2


@dataclass(frozen=True, slots=True)
class _Channel:
    """What the file header says of one channel."""

    kind: int
    bytes_per_sample: int
    sample_format: int
    legacy_samples: int
    frequency_khz: float
    corrections: int


@dataclass(frozen=True, slots=True)
class _RawPing:
    number: int
    time_utc_s: float
    channels: tuple[ChannelPing, ...]
    navigation: NavigationRecord


def read_xtf(path: Path) -> Survey:
    """Read an XTF recording.

    A file must be whole: one that ends inside a packet is an error, since a vehicle's finished recording has no
    such tail and half a ping is not worth a wrong position. What the file does not record (a field that is zero in
    every ping) is None. HSeconds of 100 (a recorder's rounding) is taken as the next second.

    Args:
        path: The file.

    Returns:
        The survey, with one warning for each kind of thing that was left out.

    Raises:
        SurveyFileError: Not an XTF file, truncated, inconsistent, without sonar pings, or unreadable.
    """
    try:
        with os.fdopen(_open_without_waiting(path), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise SurveyFileError(str(path), "", "not a regular file", "an XTF file")
            return _Recording(path, file, status.st_size).read()
    except OSError as error:
        raise SurveyFileError(str(path), "", error.strerror or str(error), "a readable XTF file") from error


def _open_without_waiting(path: Path) -> int:
    """Open without blocking, so that a named pipe in the survey folder cannot hold up the service."""
    return os.open(path, os.O_RDONLY | os.O_NONBLOCK)


class _Recording:
    """One pass through one open file."""

    def __init__(self, path: Path, file: BinaryIO, size_bytes: int) -> None:
        self._path = path
        self._file = file
        self._size_bytes = size_bytes
        self._notes: Counter[str] = Counter()

    def read(self) -> Survey:
        if not _HEADER_BYTES <= self._size_bytes <= MAX_FILE_BYTES:
            raise self._error("file size", self._size_bytes, f"{_HEADER_BYTES} to {MAX_FILE_BYTES} bytes")
        header, channels = self._read_header()
        pings = [self._ping(body, channels, place) for place, body in self._sonar_packets()]
        if not any(ping.channels for ping in pings):
            raise self._error("pings", len(pings), "at least one ping with a port or starboard channel")
        fixes, nav_notes = clean_navigation([ping.navigation for ping in pings], int(header.NavUnits))
        notes = [f"{text} ({count} times)" for text, count in sorted(self._notes.items())]
        survey = Survey(
            path=self._path,
            sonar_id=_text(header.SonarName) or "unknown",
            line_name=self._path.stem,
            pings=tuple(
                Ping(
                    number=ping.number,
                    time_utc_s=ping.time_utc_s,
                    channels=ping.channels,
                    lat_deg=fix.lat_deg,
                    lon_deg=fix.lon_deg,
                    heading_deg=fix.heading_deg,
                    altitude_m=fix.altitude_m,
                    depth_m=fix.depth_m,
                    speed_mps=fix.speed_mps,
                    pitch_deg=fix.pitch_deg,
                    roll_deg=fix.roll_deg,
                )
                for ping, fix in zip(pings, fixes, strict=True)
            ),
        )
        notes += [*nav_notes, *_port_order_note(survey)]
        return Survey(survey.path, survey.sonar_id, survey.line_name, survey.pings, tuple(notes))

    def _read_header(self) -> tuple[XTFFileHeader, list[_Channel]]:
        raw = self._take(_HEADER_BYTES, "file header")
        header = XTFFileHeader.from_buffer_copy(raw)
        if header.FileFormat != FILE_MAGIC:
            raise self._error("FileFormat", hex(header.FileFormat), hex(FILE_MAGIC))
        count = int(header.channel_count())
        if not 1 <= count <= MAX_CHANNELS or not header.NumberOfSonarChannels:
            expected = f"1 to {MAX_CHANNELS} channels, at least one of them sonar"
            raise self._error("channel counts", (int(header.NumberOfSonarChannels), count), expected)
        # The header holds six channels and grows by 1024 bytes for each further eight.
        extra = math.ceil(max(count - 6, 0) / 8)
        raw += self._take(1024 * extra, "file header")
        return header, [self._channel(raw, index) for index in range(6 + 8 * extra)]

    def _channel(self, raw: bytes, index: int) -> _Channel:
        info = XTFChanInfo.from_buffer_copy(raw, _CHAN_INFO_OFFSET + index * _CHAN_INFO_BYTES)
        return _Channel(
            kind=info.TypeOfChannel,
            bytes_per_sample=info.BytesPerSample,
            sample_format=info.SampleFormat,
            legacy_samples=info.Reserved,
            frequency_khz=info.Frequency,
            corrections=info.CorrectionFlags,
        )

    def _sonar_packets(self) -> Iterator[tuple[str, bytes]]:
        """Yield (place, bytes of the whole record) of each sonar packet; count the others."""
        while (offset := self._file.tell()) < self._size_bytes:
            place = f"packet at byte {offset}"
            raw = self._take(_START_BYTES, place)
            start = XTFPacketStart.from_buffer_copy(raw)
            if start.MagicNumber != PACKET_MAGIC:
                raise self._error(f"{place}, MagicNumber", hex(start.MagicNumber), hex(PACKET_MAGIC))
            length = int(start.NumBytesThisRecord)
            if not _START_BYTES <= length <= MAX_PACKET_BYTES:
                expected = f"{_START_BYTES} to {MAX_PACKET_BYTES} bytes"
                raise self._error(f"{place}, NumBytesThisRecord", length, expected)
            raw += self._take(length - _START_BYTES, place)
            if start.HeaderType == SONAR_PACKET:
                yield place, raw
            else:
                self._notes[f"skipped packet of type {start.HeaderType}: not a sonar ping"] += 1

    def _ping(self, raw: bytes, channels: list[_Channel], place: str) -> _RawPing:
        if len(raw) < _PING_BYTES:
            raise self._error(f"{place}, NumBytesThisRecord", len(raw), f"at least {_PING_BYTES} for a ping")
        head = XTFPingHeader.from_buffer_copy(raw)
        where = f"ping {head.PingNumber}, {place}"
        return _RawPing(
            number=int(head.PingNumber),
            time_utc_s=self._time(head, where),
            channels=tuple(self._channels(raw, int(head.NumChansToFollow), channels, where)),
            navigation=NavigationRecord.of_ping(head),
        )

    def _time(self, head: XTFPingHeader, where: str) -> float:
        stamp = (head.Year, head.Month, head.Day, head.Hour, head.Minute, head.Second)
        expected = "a UTC date and time, hundredths 0 to 100"
        if head.HSeconds > 100:
            raise self._error(f"{where}, HSeconds", head.HSeconds, expected)
        try:
            whole = datetime(*stamp, tzinfo=UTC)
        except ValueError as error:
            raise self._error(f"{where}, date and time", stamp, expected) from error
        return whole.timestamp() + float(head.HSeconds) / 100

    def _channels(self, raw: bytes, count: int, channels: list[_Channel], where: str) -> Iterator[ChannelPing]:
        offset = _PING_BYTES
        for _ in range(count):
            if offset + _PING_CHAN_BYTES > len(raw):
                raise self._error(f"{where}, NumChansToFollow", count, "as many channels as the record holds")
            head = XTFPingChanHeader.from_buffer_copy(raw, offset)
            offset += _PING_CHAN_BYTES
            number = int(head.ChannelNumber)
            if number >= len(channels):
                raise self._error(f"{where}, ChannelNumber", number, f"0 to {len(channels) - 1}")
            info = channels[number]
            bytes_per_sample = self._sample_bytes(info, number)
            samples = int(head.NumSamples) or info.legacy_samples
            end = offset + samples * bytes_per_sample
            if end > len(raw):
                room = (len(raw) - offset) // bytes_per_sample
                raise self._error(f"{where}, channel {number}, NumSamples", samples, f"at most {room}")
            channel = self._channel_ping(head, info, raw[offset:end])
            offset = end
            if channel is not None:
                yield channel

    def _sample_bytes(self, info: _Channel, number: int) -> int:
        size = info.bytes_per_sample
        if size not in _SAMPLE_BYTES:
            raise self._error(f"channel {number}, BytesPerSample", size, "1, 2 or 4")
        # A side-scan channel must hold plain integers; what else flows past unused may hold anything of that size.
        if info.kind in _SIDES and info.sample_format and _FORMAT_BYTES.get(info.sample_format) != size:
            expected = f"0, or the unsigned integer of {size} bytes"
            raise self._error(f"channel {number}, SampleFormat", info.sample_format, expected)
        if info.kind in _SIDES and info.corrections == _GROUND_RANGE:
            raise self._error(f"channel {number}, CorrectionFlags", info.corrections, "slant-range samples (1)")
        return size

    def _channel_ping(self, head: XTFPingChanHeader, info: _Channel, raw: bytes) -> ChannelPing | None:
        side = _SIDES.get(info.kind)
        slant_range_m = float(head.SlantRange)
        if side is None:
            name = _CHANNEL_NAMES.get(info.kind, f"type {info.kind}")
            self._notes[f"skipped channel: {name}, not side-scan"] += 1
            return None
        if not raw or not math.isfinite(slant_range_m) or slant_range_m <= 0:
            self._notes[f"skipped {side.value} channel: no samples or no slant range"] += 1
            return None
        if head.TimeDelay:
            self._notes["recording began after the transmission (TimeDelay): ranges are not shifted for it"] += 1
        if head.Weight:
            self._notes["sample weight (power of two) is not applied"] += 1
        return ChannelPing(
            side=side,
            samples=_samples(raw, info.bytes_per_sample, reverse=side is Side.PORT),
            slant_range_m=slant_range_m,
            frequency_hz=_frequency_hz(float(head.Frequency) or info.frequency_khz),
        )

    def _take(self, count: int, place: str) -> bytes:
        left = self._size_bytes - self._file.tell()
        if count > left:
            raise self._error(place, f"{left} bytes left", f"{count} bytes: the file is truncated")
        raw = self._file.read(count)
        if len(raw) != count:
            raise self._error(place, f"{len(raw)} bytes", f"{count} bytes: the file shrank while it was read")
        return raw

    def _error(self, field: str, value: object, expected: str) -> SurveyFileError:
        return SurveyFileError(str(self._path), field, value, expected)


def _samples(raw: bytes, bytes_per_sample: int, *, reverse: bool) -> Samples:
    """Return little-endian unsigned integers in the machine's own order, turned round if asked."""
    step = -1 if reverse else 1
    if bytes_per_sample == 1:
        return np.frombuffer(raw, dtype=np.uint8)[::step].copy()
    if bytes_per_sample == 2:
        return np.frombuffer(raw, dtype="<u2")[::step].astype(np.uint16)
    return np.frombuffer(raw, dtype="<u4")[::step].astype(np.uint32)


def _text(raw: bytes) -> str:
    """Decode a fixed-width text field: recorders pad with zeros or blanks and use their own code pages."""
    return "".join(c for c in raw.decode("latin-1") if c.isprintable()).strip()


def _frequency_hz(value_khz: float) -> float | None:
    """Return the frequency in hertz; the field is in kHz, but some recorders write hertz.

    Side-scan sonars work between about 50 kHz and 3 MHz, so the two readings cannot be confused.
    """
    if not math.isfinite(value_khz) or value_khz <= 0:
        return None
    return value_khz * 1000 if value_khz < 10_000 else value_khz


def _port_order_note(survey: Survey) -> list[str]:
    """Say so when port looks stored nearest sample first, against the format: then it is turned the wrong way.

    Both sides see the same water column and much the same seabed, so their mean profiles agree when both begin at
    the vehicle. Nothing is turned on this evidence alone.
    """
    profiles = []
    for side in (Side.PORT, Side.STARBOARD):
        image = survey.waterfall(side)
        if image.shape[1] < 64 or image.shape[0] < 64:
            return []
        columns = image[:, : image.shape[1] // 32 * 32].reshape(image.shape[0], 32, -1)
        profiles.append(np.log1p(np.nan_to_num(columns).mean(axis=(0, 2), dtype=np.float64)))
    port, starboard = (profile - profile.mean() for profile in profiles)
    scale = float(np.linalg.norm(port) * np.linalg.norm(starboard))
    if scale == 0 or float(port[::-1] @ starboard) < 0.5 * scale or float(port @ starboard) > 0:
        return []
    return ["port looks stored nearest sample first, against the format: its picture may be mirrored"]
