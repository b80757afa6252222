"""Reader of Cerulean SVLOG recordings of Omniscan side-scan sonars.

The layout is that of the published Ping protocol and of open readers; no recording of a sonar was read. A file is a
sequence of packets: B R, u16 payload length, u16 identifier, source, destination, payload, u16 sum of all bytes before
it. All values are little endian. These are read: 10 (JSON, a session with its date), 150 (JSON, a MAVLink message), 109
(NMEA sentences) and 2198 (the profile of one transducer).

Conversions and assumptions:

* The side is that of the look angle of the transducer (+90 degrees starboard, -90 or 270 port). If no profile of the
  file has one, it is that of the channel number: 0 port, 1 starboard.
* Profiles of several transducers are joined to pings and dated, see `svlog_timeline`.
* Profiles are scaled in decibels of power. The samples are amplitudes, 10^(dB/20), so that echo strength is linear.
* The range extends from the start of a profile over its length; a start above 0 is padded with zeros.
* Positions, motion and attitude are those of the last message before the profile, up to five seconds old. Without one
  the heading is that of the profile. The altitude comes from bottom tracking.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import groupby
from typing import Final

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from sonarpost.sonar.navigation import plausible_angle
from sonarpost.sonar.readers.file_source import FileSource
from sonarpost.sonar.readers.records import Notes, RecordFormat, records
from sonarpost.sonar.readers.svlog_messages import NavigationMessages, json_object, number
from sonarpost.sonar.readers.svlog_timeline import Profile, SessionClock, Timeline, has_restarted
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side

MAGIC: Final = b"BR"
SESSION, NMEA, MAVLINK, PROFILE = 10, 109, 150, 2198

_HEADER: Final = struct.Struct("<2sHHBB")
_MAX_KIND: Final = 9999
_CHECKSUM_BYTES: Final = 2
_PROFILE: Final = struct.Struct("<5I3HBx6f")
_LOOK_ANGLE_FIELD: Final = 13
_SIDES: Final = {0: Side.PORT, 1: Side.STARBOARD}
_MAX_DECIBEL: Final = 300.0
_FULL_SCALE: Final = 65_535
_MAX_LEAD: Final = 4
"""Maximum number of samples before the first recorded one, as a multiple of the recorded ones."""
_FREQUENCIES_HZ: Final = (1e4, 1e7)


class _Packet(RecordFormat):
    name = "packet"
    magic = MAGIC
    head_bytes = _HEADER.size
    has_checksum = True

    @override
    def length(self, head: bytes, offset: int) -> int:
        magic, length, kind, *_ = _HEADER.unpack(head)
        return _HEADER.size + length + _CHECKSUM_BYTES if magic == MAGIC and 0 < kind <= _MAX_KIND else 0

    @override
    def is_proved(self, raw: bytes) -> bool:
        stored, calculated = _checksums(raw)
        return stored == calculated


_PACKET: Final = _Packet()


class SvlogSource(FileSource):
    """An open SVLOG recording.

    Raises:
        SurveyFileError: Not an SVLOG file, without a date or a profile, or unreadable.
    """

    SONAR = "Omniscan"

    @override
    def _prepare(self) -> None:
        self._transducers: Counter[tuple[Side, int]] = Counter()
        self._one_sided = 0
        # Ends at the first profile of most files.
        self._has_look_angles = any(
            _side(_PROFILE.unpack_from(payload)[_LOOK_ANGLE_FIELD]) is not None
            for _, kind, payload in self._packets(Notes())
            if kind == PROFILE and len(payload) >= _PROFILE.size
        )

    @override
    def _format_warnings(self) -> list[str]:
        warnings = super()._format_warnings()
        sides = {side for side, _ in self._transducers}
        if len(sides) > 1 and self._one_sided:
            warnings.append(f"only one side in {self._one_sided} of {self._pings} pings")
        elif len(sides) == 1:
            count = len(self._transducers)
            warnings.append(f"only {count} transducer{'s' * (count > 1)}, to {min(sides)}")
        return warnings

    @override
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        timeline = Timeline(self._file, notes)
        for _, segment in groupby(self._profiles(notes), key=lambda profile: profile.segment):
            for ping in timeline.pings(segment):
                if notes is self._notes:  # the first pass
                    self._transducers.update((channel.side, channel.index) for channel in ping.channels)
                    self._one_sided += len({channel.side for channel in ping.channels}) == 1
                yield ping

    def _packets(self, notes: Notes) -> Iterator[tuple[str, int, bytes]]:
        """Yield place, identifier and payload of every packet with a right checksum."""
        for place, _, raw in records(self._file, _PACKET, 0, notes):
            with notes.leaving_out(place):
                stored, calculated = _checksums(raw)
                if stored != calculated:
                    raise self._file.error(f"{place}, checksum", stored, str(calculated))
                yield place, _HEADER.unpack_from(raw)[2], raw[_HEADER.size : -_CHECKSUM_BYTES]

    def _profiles(self, notes: Notes) -> Iterator[Profile]:
        """Yield the profiles; a session, and a restart of a sonar, begin a segment."""
        messages = NavigationMessages(notes)
        session: SessionClock | None = None
        segment = 0
        clocks_s: dict[tuple[Side, int], float] = {}
        for place, kind, payload in self._packets(notes):
            with notes.leaving_out(place):
                if kind == MAVLINK:
                    messages.mavlink(payload)
                elif kind == NMEA:
                    messages.nmea(payload)
                elif kind == SESSION:
                    found = self._session(payload, place, notes)
                    if found is not None and (session is None or found.utc_s != session.utc_s):  # not a copy
                        session = found
                        segment += 1
                        clocks_s.clear()
                        messages.start_session()
                elif kind == PROFILE:
                    received = messages.before_profile()
                    channel = self._channel(place, payload, notes)
                    if channel is None:
                        continue
                    number_of_ping, _, _, clock_ms, *_, vehicle_heading_deg = _PROFILE.unpack_from(payload)
                    clock_s = clock_ms / 1000
                    if has_restarted(clock_s, clocks_s.get((channel.side, channel.index), 0.0)):
                        segment += 1
                        clocks_s.clear()
                    clocks_s[channel.side, channel.index] = clock_s
                    # Exactly 0 is the value of a sonar without a vehicle's heading.
                    heading_deg = plausible_angle(vehicle_heading_deg) if vehicle_heading_deg != 0 else None
                    yield Profile(place, segment, session, number_of_ping, clock_s, channel, received, heading_deg)

    def _session(self, payload: bytes, place: str, notes: Notes) -> SessionClock | None:
        """Return the session that a packet starts; None if it has no date.

        Raises:
            SurveyFileError: The date is invalid.
        """
        session = json_object(payload)
        stamp = session.get("timestamp")
        if stamp is None:
            notes.add("ignored session packet: no timestamp")
            return None
        utc_s = _utc_s(stamp) if isinstance(stamp, str) else None
        if utc_s is None or utc_s < 0:
            expected = "an ISO 8601 date and time from 1970 on"
            raise self._file.error(f"{place}, timestamp", str(stamp)[:80], expected)
        return SessionClock(utc_s, number(session.get("os_uptime")))

    def _channel(self, place: str, raw: bytes, notes: Notes) -> ChannelPing | None:
        """Return the channel of a profile; None if it is not of a side, or its range or scale is impossible.

        Raises:
            SurveyFileError: The packet is shorter than a profile.
        """
        if len(raw) < _PROFILE.size:
            raise self._file.error(f"{place}, length", len(raw), f"at least {_PROFILE.size} for a profile")
        _, start_mm, length_mm, _, frequency_hz, _, count, _, channel_number, *floats = _PROFILE.unpack_from(raw)
        _, _, max_db, min_db, look_angle_deg, _ = floats
        if count * 2 > len(raw) - _PROFILE.size:
            limit = (len(raw) - _PROFILE.size) // 2
            raise self._file.error(f"{place}, number of results", count, f"up to {limit}")
        side = _side(look_angle_deg) if self._has_look_angles else _SIDES.get(channel_number)
        if side is None:
            found = f"a look angle of {look_angle_deg:g} degrees" if self._has_look_angles else "no look angle"
            notes.add(f"skipped profile: channel {channel_number} has {found}, thus no side")
            return None
        lead = round(start_mm / length_mm * count) if length_mm else 0
        if not count or not 0 < start_mm + length_mm <= MAX_SLANT_RANGE_M * 1000 or lead > _MAX_LEAD * count:
            notes.add(f"skipped {side.value} profile: no samples, or impossible range")
            return None
        if not -_MAX_DECIBEL <= min_db <= max_db <= _MAX_DECIBEL:  # includes NaN
            notes.add(f"skipped {side.value} profile: impossible scale in decibels")
            return None
        if not self._has_look_angles:
            notes.add("side guessed from the channel number, without a look angle")
        values = np.frombuffer(raw, "<u2", count, _PROFILE.size)
        samples = np.concatenate([np.zeros(lead, np.float32), _amplitudes(values, min_db, max_db)])
        low_hz, high_hz = _FREQUENCIES_HZ
        return ChannelPing(
            side=side,
            samples=samples,
            slant_range_m=length_mm / 1000 * (lead + count) / count,
            frequency_hz=float(frequency_hz) if low_hz <= frequency_hz <= high_hz else None,
            index=channel_number,
        )


def _checksums(raw: bytes) -> tuple[int, int]:
    """Return the checksum at the end of a packet, and the right one."""
    values = np.frombuffer(raw, np.uint8, len(raw) - _CHECKSUM_BYTES)
    return int.from_bytes(raw[-_CHECKSUM_BYTES:], "little"), int(values.sum(dtype=np.uint32)) & 0xFFFF


def _side(look_angle_deg: float) -> Side | None:
    """Return the side of a look angle; None for one ahead, astern, or not finite."""
    if not math.isfinite(look_angle_deg) or look_angle_deg % 180 == 0:
        return None
    return Side.STARBOARD if look_angle_deg % 360 < 180 else Side.PORT


def _utc_s(stamp: str) -> float | None:
    """Return the time of an ISO 8601 text, UTC without a zone, seconds since 1970; None for another value."""
    try:
        when = datetime.fromisoformat(stamp)
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def _amplitudes(values: npt.NDArray[np.uint16], min_db: float, max_db: float) -> npt.NDArray[np.float32]:
    decibel = min_db + values.astype(np.float64) * ((max_db - min_db) / _FULL_SCALE)
    return (10 ** (decibel / 20)).astype(np.float32)
