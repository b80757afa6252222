"""XTF as different recorders write it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer
from pyxtf import XTFPingHeader

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.xtf import read_xtf
from sonarpost.sonar.survey import ChannelPing, Side
from sonarpost.sonar.xtf_writer import write_xtf

HEADER, PACKET = 1024, 512
CHANNEL = HEADER + 256
CHANNEL_BYTES = 64 + 40
WEIGHT, TIME_DELAY, TIME_DURATION = 58, 12, 16


@pytest.fixture
def raw(small_survey, tmp_path) -> bytearray:
    write_xtf(small_survey(), tmp_path / "whole.xtf")
    return bytearray((tmp_path / "whole.xtf").read_bytes())


def read(tmp_path: Path, content: bytes, **options):
    (tmp_path / "a.xtf").write_bytes(content)
    return read_xtf(tmp_path / "a.xtf", SurveyOptions(**options))


def in_every_ping(raw: bytearray, offset: int, fmt: str, *values: float) -> bytearray:
    for row in range(5):
        struct.pack_into("<" + fmt, raw, HEADER + row * PACKET + offset, *values)
    return raw


def attitude(time: tuple[int, ...], pitch: float, roll: float, heading: float) -> bytes:
    year, month, day, hour, minute, second, millisecond = time
    body = struct.pack("<HBBHHHI", 0xFACE, 3, 0, 0, 0, 0, 64) + bytes(16)
    body += struct.pack("<ffffIf", pitch, roll, 0, 0, 0, heading)
    return body + struct.pack("<HBBBBBHB", year, month, day, hour, minute, second, millisecond, 0)


def test_a_weight_scales_the_echo_and_not_the_samples(raw, tmp_path):
    struct.pack_into("<h", raw, CHANNEL + WEIGHT, 3)
    struct.pack_into("<h", raw, CHANNEL + CHANNEL_BYTES + WEIGHT, -2)
    plain, weighted = read(tmp_path, in_every_ping(bytearray(raw), 256 + WEIGHT, "h", 0)), read(tmp_path, raw)
    port, starboard = weighted.pings[0].channels
    assert (port.scale, starboard.scale) == (1 / 8, 4.0)
    np.testing.assert_array_equal(port.samples, plain.pings[0].channels[0].samples)
    np.testing.assert_array_equal(port.echo(), port.samples / np.float32(8))
    np.testing.assert_array_equal(weighted.waterfall(Side.STARBOARD)[0], starboard.samples * np.float32(4))
    struct.pack_into("<h", raw, CHANNEL + WEIGHT, 999)
    assert "sample weight beyond ±31 is not applied (1 times)" in read(tmp_path, raw).warnings


@pytest.mark.parametrize("counts_the_delay", [True, False])
def test_a_late_beginning_keeps_every_echo_at_its_range(raw, tmp_path, counts_the_delay):
    """25 m in 40 samples, recorded from 12.5 m (or its own length) on."""
    in_every_ping(raw, 32, "f", 750.0)
    duration_s = 25 / 750 / (2 if counts_the_delay else 1)
    for offset in (256, 256 + CHANNEL_BYTES):
        in_every_ping(raw, offset + TIME_DELAY, "ff", duration_s, duration_s)
    survey = read(tmp_path, raw)
    channel = survey.pings[0].channels[1]
    assert channel.samples.shape == (80,)
    assert not channel.samples[:40].any()
    assert channel.slant_range_m == pytest.approx(25 if counts_the_delay else 50)
    assert any("zeros replace" in w for w in survey.warnings)


def test_a_late_beginning_that_agrees_with_nothing_is_left_out(raw, tmp_path):
    in_every_ping(raw, 256 + TIME_DELAY, "ff", 0.5, 0.001)
    survey = read(tmp_path, raw)
    assert survey.sides() == (Side.STARBOARD,)
    assert any("TimeDelay, SlantRange and TimeDuration disagree" in w for w in survey.warnings)


def test_attitude_packets_fill_what_no_ping_has(raw, tmp_path):
    in_every_ping(raw, 204, "fff", 0, 0, 0)  # pitch, roll, heading
    first = attitude((2013, 9, 10, 21, 13, 8, 100), 1.5, -2.5, 123.0)
    later = attitude((2013, 9, 10, 21, 13, 8, 800), 2.5, -3.5, 124.0)
    body = raw[:HEADER] + first + raw[HEADER : HEADER + 2 * PACKET] + later + raw[HEADER + 2 * PACKET :]
    survey = read(tmp_path, body)
    # Pings are 0.37 s apart from 8.13 s on: the last lies within a second of the second packet.
    assert [p.heading_deg for p in survey] == [123, 123, 124, 124, 124]
    assert [p.pitch_deg for p in survey] == [1.5, 1.5, 2.5, 2.5, 2.5]
    assert survey.pings[0].roll_deg == -2.5
    assert survey.warnings == ("heading_deg, pitch_deg, roll_deg from attitude packets (2 of them)",)
    old = attitude((2013, 9, 10, 21, 13, 7, 0), 1.5, -2.5, 123.0)
    assert read(tmp_path, raw[:HEADER] + old + raw[HEADER:]).pings[0].heading_deg is None


def test_a_heading_that_attitude_packets_leave_at_zero_is_unknown(raw, tmp_path):
    in_every_ping(raw, 204, "fff", 0, 0, 0)
    packet = attitude((2013, 9, 10, 21, 13, 8, 100), 1.5, -2.5, 0.0)
    survey = read(tmp_path, raw[:HEADER] + packet + raw[HEADER:])
    assert survey.pings[0].heading_deg is None
    assert survey.pings[0].pitch_deg == 1.5


def test_the_pings_own_attitude_goes_first(raw, tmp_path):
    packet = attitude((2013, 9, 10, 21, 13, 8, 100), 40.0, 40.0, 40.0)
    survey = read(tmp_path, raw[:HEADER] + packet + raw[HEADER:])
    assert (survey.pings[0].heading_deg, survey.pings[0].pitch_deg) == (354.5, -2.5)


def test_projected_metres_need_their_projection(raw, tmp_path):
    to_utm = Transformer.from_crs(4326, 32619, always_xy=True)
    easting, northing = to_utm.transform(-68.827935, 48.44545)
    struct.pack_into("<H", raw, 164, 0)
    in_every_ping(raw, 160, "dd", northing, easting)
    assert all(p.lat_deg is None for p in read(tmp_path, raw))
    survey = read(tmp_path, raw, projected_crs="EPSG:32619")
    for ping in survey:
        off_m = offset_between_m(Position(48.44545, -68.827935), Position(ping.lat_deg, ping.lon_deg))
        assert np.hypot(*off_m) < 0.001
    assert survey.warnings == ()
    for wrong in ("EPSG:4326", "EPSG:999999", "nonsense", "EPSG:2225"):  # degrees, unknown, none, US feet
        with pytest.raises(SurveyFileError, match="projected_crs"):
            read(tmp_path, raw, projected_crs=wrong)


def test_metres_that_look_like_degrees_are_metres(raw, tmp_path):
    """A local grid with small coordinates: NavUnits decides, not the values."""
    struct.pack_into("<H", raw, 164, 0)
    in_every_ping(raw, 160, "dd", 48.4, -68.8)
    assert all(p.lat_deg is None for p in read(tmp_path, raw))
    metres = read(tmp_path, raw, projected_crs="+proj=utm +zone=19 +datum=WGS84 +units=m")
    assert all(abs(p.lat_deg) < 1 for p in metres)


def test_degrees_are_degrees_even_when_a_projection_is_given(raw, tmp_path):
    assert read(tmp_path, raw, projected_crs="EPSG:32619").pings[0].lat_deg == 48.44545


def test_coordinates_outside_the_projection_give_no_position(raw, tmp_path):
    struct.pack_into("<H", raw, 164, 0)
    in_every_ping(raw, 160, "dd", 1e30, 1e30)
    survey = read(tmp_path, raw, projected_crs="EPSG:32619")
    assert survey.warnings == ("no position fix in 5 of 5 pings, the first in row 0",)


def test_the_ships_position_when_asked_for(raw, tmp_path):
    in_every_ping(raw, XTFPingHeader.ShipYcoordinate.offset, "dd", 10.0, 20.0)
    assert read(tmp_path, raw).pings[0].lat_deg == 48.44545
    ship = read(tmp_path, raw, position_source="ship").pings[0]
    assert (ship.lat_deg, ship.lon_deg) == (10.0, 20.0)


def test_the_other_order_of_port_when_asked_for(raw, tmp_path):
    one = read(tmp_path, raw).pings[0].channels[0].samples
    other = read(tmp_path, raw, port_order="nearest_first").pings[0].channels[0].samples
    np.testing.assert_array_equal(one, other[::-1])


def test_32_bit_samples_beyond_single_precision_survive(small_survey, tmp_path):
    survey = small_survey(np.uint32)
    survey.pings[0].channels[0].samples[:3] = (2**32 - 1, 2**31 + 1, 2**24 + 1)
    write_xtf(survey, tmp_path / "a.xtf")
    channel: ChannelPing = read_xtf(tmp_path / "a.xtf").pings[0].channels[0]
    assert channel.samples[:3].tolist() == [2**32 - 1, 2**31 + 1, 2**24 + 1]


def test_bathymetry_and_unknown_packets_flow_past(raw, tmp_path):
    packets = b"".join(
        struct.pack("<HBBHHHI", 0xFACE, kind, 0, 0, 0, 0, 14 + 300) + bytes(range(256)) + bytes(44)
        for kind in (1, 2, 8, 65, 107, 199, 255)
    )
    survey = read(tmp_path, raw[:HEADER] + packets + raw[HEADER:] + packets)
    assert len(survey.pings) == 5
    assert len(survey.warnings) == 7
    assert all("(2 times)" in warning for warning in survey.warnings)


@pytest.mark.parametrize("slant_range_m", [1e30, 10_001, float("nan"), float("inf"), -5])
def test_a_slant_range_no_sonar_has_is_left_out(raw, tmp_path, slant_range_m):
    survey = read(tmp_path, in_every_ping(raw, 256 + 4, "f", slant_range_m))
    assert survey.sides() == (Side.STARBOARD,)
    assert survey.warnings == ("skipped port channel: no samples or no slant range (5 times)",)
