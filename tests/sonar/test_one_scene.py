"""One scene recorded in every format: the contact has the same place, side and time in all of them."""

import json
import struct
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from builders.surveys import MAKERS, make_lowrance, make_xtf

from sonarpost.cli.main import main
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.survey import ChannelPing, Side

pytestmark = pytest.mark.system

RANGE_M = 25.0
"""That of the makers of formats which store no range of their own."""
PING_BYTES, CHANNEL_BYTES = 256, 64
PROFILE, PROFILE_CHANNEL = 2198, 34


@pytest.fixture(scope="module")
def scene():
    """A survey with one mine-like object, as samples of 8 bits."""
    made = simulate_survey(SurveySpec(seed=3, pings=400, samples=500, range_m=RANGE_M, targets=1, clutter=0)).survey

    def without_zeros(channel):  # as decibels, a sample of 0 is one of 1
        return ChannelPing(channel.side, np.maximum(channel.samples, 1), RANGE_M, 450e3)

    others = {"depth_m": 12.0, "pitch_deg": 1.5, "roll_deg": -2.0}  # some makers need all fields
    pings = tuple(replace(p, channels=tuple(map(without_zeros, p.channels)), **others) for p in made)
    return replace(made, pings=pings)


def with_low_frequency(survey):
    """Return the survey with channels of another frequency and twice the range behind those of each ping."""

    def low(channel):
        half = channel.samples[: len(channel.samples) // 2 * 2].reshape(-1, 2).mean(axis=1).astype(np.uint8)
        return ChannelPing(channel.side, np.concatenate([half, np.ones_like(half)]), 2 * RANGE_M, 120e3)

    return replace(survey, pings=tuple(replace(p, channels=(*p.channels, *map(low, p.channels))) for p in survey.pings))


def in_packets(path, channels_each, first):
    """Write each packet of an XTF file as packets of `channels_each` channels; `first` numbers them by subchannel."""
    data = path.read_bytes()
    out, offset = bytearray(data[:1024]), 1024
    while offset < len(data):
        (size,) = struct.unpack_from("<I", data, offset + 10)
        head, place = data[offset : offset + PING_BYTES], offset + PING_BYTES
        (count,) = struct.unpack_from("<H", head, 4)
        bodies = []
        for _ in range(count):
            (samples,) = struct.unpack_from("<I", data, place + 42)
            end = place + CHANNEL_BYTES + samples
            bodies.append(data[place:end])
            place = end
        for number in range(0, count, channels_each):
            body = b"".join(bodies[number : number + channels_each])
            packet = bytearray(head) + body
            packet += bytes(-len(packet) % 64)
            packet[3] = number // channels_each if first else 0
            struct.pack_into("<H", packet, 4, len(bodies[number : number + channels_each]))
            struct.pack_into("<I", packet, 10, len(packet))
            out += packet
        offset += size
    path.write_bytes(out)
    return path


def version_13(survey, folder):
    """Write an SL3 file of frame version 13, whose header has 180 bytes."""
    path = make_lowrance(survey, folder)
    data, offset = path.read_bytes(), 8
    out = bytearray(data[:8])
    while offset < len(data):
        (size,) = struct.unpack_from("<H", data, offset + 8)
        frame = bytearray(data[offset : offset + 168] + bytes(12) + data[offset + 168 : offset + size])
        struct.pack_into("<I", frame, 0, len(out))
        frame[4] = 13
        struct.pack_into("<H", frame, 8, len(frame))
        out += frame
        offset += size
    path.write_bytes(out)
    return path


def one_unit(survey, folder):
    """Write an SVLOG file of one transducer, on the side of the object."""
    path = MAKERS["svlog"](survey, folder)
    data, offset = path.read_bytes(), 0
    out = bytearray()
    while offset < len(data):
        length, kind = struct.unpack_from("<HH", data, offset + 2)
        if kind != PROFILE or data[offset + PROFILE_CHANNEL] == list(Side).index(Side.PORT):
            out += data[offset : offset + 10 + length]
        offset += 10 + length
    path.write_bytes(out)
    return path


LAYOUTS = {
    "xtf": make_xtf,
    "xtf, a packet a side": lambda s, folder: in_packets(make_xtf(s, folder), 1, first=True),
    "xtf, two frequencies": lambda s, folder: make_xtf(with_low_frequency(s), folder),
    "xtf, a packet a frequency": lambda s, folder: in_packets(make_xtf(with_low_frequency(s), folder), 2, first=False),
    "jsf": MAKERS["jsf"],
    "sdf": MAKERS["sdf"],
    "sl2": MAKERS["sl2"],
    "sl3, version 10": MAKERS["sl3"],
    "sl3, version 13": version_13,
    "svlog": MAKERS["svlog"],
    "svlog, one unit": one_unit,
    "humminbird": MAKERS["humminbird"],
}


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    path = tmp_path_factory.mktemp("options") / "options.toml"
    path.write_text(f"humminbird_sample_spacing_m = {RANGE_M / 500}\n")
    return path


def the_contact(path, options, capsys):
    assert main(["detect", str(path), "--options", str(options), "--json", "--max-contacts", "1"]) == 0
    (listed,) = json.loads(capsys.readouterr().out)["files"]
    return listed["contacts"][0]


@pytest.fixture(scope="module")
def reference(scene, options, tmp_path_factory):
    return make_xtf(scene, tmp_path_factory.mktemp("reference"))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_contact_agrees_within_half_a_metre_and_a_tenth_of_a_second(
    layout, scene, reference, options, tmp_path, capsys
):
    expected = the_contact(reference, options, capsys)
    found = the_contact(LAYOUTS[layout](scene, tmp_path), options, capsys)
    assert found["channel"] == expected["channel"]
    off_m = offset_between_m(*(Position(each["lat_deg"], each["lon_deg"]) for each in (expected, found)))
    assert np.hypot(*off_m) < 0.5
    times = [datetime.fromisoformat(each["time_utc"]) for each in (expected, found)]
    assert abs((times[1] - times[0]).total_seconds()) < 0.1
