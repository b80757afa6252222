"""Reader of XTF (eXtended Triton Format) side-scan recordings, ping by ping.

A ping may be spread over several packets: a packet a side, a frequency, or both. They have the same PingNumber and the
same time. SubChannelNumber tells frequencies apart, or sides, or is always 0.

The first of three passes finds what the fields of the packets are used for; `xtf_packets` has the layout and
`xtf_navigation` the meaning of the positions.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt
from typing_extensions import override

from sonarpost.sonar.readers.file_source import FileSource
from sonarpost.sonar.readers.joining import PingPart, joined
from sonarpost.sonar.readers.records import Notes, records
from sonarpost.sonar.readers.xtf_navigation import Navigation, PingHead
from sonarpost.sonar.readers.xtf_packets import (
    ATTITUDE_PACKET,
    SONAR_PACKET,
    Numbering,
    PacketParser,
    parse_attitude,
    read_header,
)
from sonarpost.sonar.survey import ChannelPing, Ping, Side

_MAX_GAP_S: Final = 0.055
"""Maximum difference between the times, in hundredths of a second, of the packets of a ping."""
_HELD_PINGS: Final = 16
"""Longer than the batches in which a recorder writes the packets of a side: a packet may have 16 MiB."""
_PROFILE_COLUMNS: Final = 32
_PROFILE_PINGS: Final = 64


class XtfSource(FileSource):
    """An open XTF recording.

    Pitch, roll and heading that no ping contains are taken from attitude packets up to one second before the ping.

    Raises:
        SurveyFileError: Not an XTF file, without a valid sonar ping, or unreadable.
    """

    @override
    def _prepare(self) -> None:
        self._header, channels, self._first_packet = read_header(self._file)
        self._numbering = Numbering(channels)
        self._navigation = Navigation(int(self._header.NavUnits), self.options)
        self._port_order = _PortOrderCheck()
        notes = Notes()
        parser = self._parser(notes)
        for place, _, raw in records(self._file, parser, self._first_packet, notes):
            if raw[2] == ATTITUDE_PACKET and (attitude := parse_attitude(raw)) is not None:
                self._navigation.scan_attitude(attitude[1])
            elif raw[2] == SONAR_PACKET and any(raw[4:6]):
                with notes.leaving_out(place):
                    head, _ = parser.header(raw, place)
                    self._navigation.scan(head)
                    self._numbering.observe(raw, head)
        self._navigation.conclude()
        self._numbering.conclude()

    def _parser(self, notes: Notes) -> PacketParser:
        farthest_first = self.options.port_order == "farthest_first"
        return PacketParser(self._file, self._numbering, notes, port_farthest_first=farthest_first)

    @override
    def _sonar_name(self) -> str:
        return decode_text(self._header.SonarName)

    @override
    def _format_warnings(self) -> list[str]:
        navigation = self._navigation.warnings(self._notes.pings, self._pings)
        return [*super()._format_warnings(), *navigation, *self._port_order.warnings()]

    @override
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        by_number = self._numbering.repeats_pings
        pings = joined(self._parts(notes), max_gap_s=_MAX_GAP_S, by_number=by_number, held_pings=_HELD_PINGS)
        for row, part in enumerate(pings):
            if notes is self._notes:  # the first pass
                self._port_order.observe(part.channels)
            yield self._navigation.ping(part, row, notes.pings)

    def _parts(self, notes: Notes) -> Iterator[PingPart[PingHead]]:
        """Yield the side-scan channels of each sonar packet."""
        parser, attitude = self._parser(notes), None
        for place, _, raw in records(self._file, parser, self._first_packet, notes):
            kind = raw[2]
            if kind == ATTITUDE_PACKET and (parsed := parse_attitude(raw)) is not None:
                attitude = parsed
            elif kind != SONAR_PACKET:
                notes.add(f"skipped packet of type {kind}: not a sonar ping")
            elif not any(raw[4:6]):
                notes.add("skipped packet without channels: not a ping")
            else:
                with notes.leaving_out(place):
                    head, time_utc_s = parser.header(raw, place)
                    channels = tuple(parser.channels(raw, head, place))
                    if channels:
                        yield PingPart(int(head.PingNumber), time_utc_s, (head, attitude), channels)


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


def decode_text(raw: bytes) -> str:
    """Decode a fixed-width text field, padded with zeros or blanks: UTF-8, or else any code page as Latin-1."""
    try:
        text = raw.decode()
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return "".join(c for c in text if c.isprintable()).strip()
