"""Survey files of every format with the content of a `Survey`."""

import csv
import io
import json
import math
import struct
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from builders.xtf import write_xtf
from sonarpost.sonar.image_files import write_png, write_tiff
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

RADIUS_M = 6_378_388.0


def small_survey(dtype: type = np.uint8, pings: int = 5, samples: int = 40) -> Survey:
    """Return a survey of a few pings with different samples on both sides."""
    rng = np.random.default_rng(3)
    navigation = {"lon_deg": -68.827935, "heading_deg": 354.5, "altitude_m": 6.25, "depth_m": 14.5}
    navigation |= {"speed_mps": 1.03125, "pitch_deg": -2.5, "roll_deg": 3.75}
    made = []
    for row in range(pings):
        images = (rng.integers(0, np.iinfo(dtype).max, samples, dtype=dtype, endpoint=True) for _ in Side)
        channels = tuple(ChannelPing(side, image, 25.0, 600_000.0) for side, image in zip(Side, images, strict=True))
        time_utc_s = 1_378_847_588.13 + row * 0.37
        made.append(Ping(row + 10, time_utc_s, channels, lat_deg=48.44545 + row * 1e-6, **navigation))
    return Survey(Path("made.xtf"), "HDS", "made", tuple(made))


def make_xtf(survey: Survey, folder: Path) -> Path:
    write_xtf(survey, folder / "line.xtf")
    return folder / "line.xtf"


def mercator(lat_deg: float, lon_deg: float) -> tuple[int, int]:
    """Return Mercator coordinates in whole metres, as Humminbird recorders store them."""
    geocentric = math.atan(math.tan(math.radians(lat_deg)) / 1.0067642927)
    north_m = RADIUS_M * math.asinh(math.tan(geocentric))
    return round(math.radians(lon_deg) * RADIUS_M), round(north_m)


def son_ping(number: int, time_ms: int, samples: bytes, extra: bytes = b"", **values: int) -> bytes:
    """Return a ping of a SON file; values are `east`, `north`, `heading`, `speed` and `depth` in the format's units."""
    fields = struct.pack(">BIBI", 0x80, number, 0x81, time_ms)
    fields += struct.pack(">BiBi", 0x82, values.get("east", 0), 0x83, values.get("north", 0))
    fields += struct.pack(">BHHBHH", 0x84, 1, values.get("heading", 0), 0x85, 1, values.get("speed", 0))
    fields += struct.pack(">BI", 0x87, values.get("depth", 0)) + b"\x50\x02" + struct.pack(">BI", 0x92, 455_000) + extra
    return b"\xc0\xde\xab\x21" + fields + struct.pack(">BIB", 0xA0, len(samples), 0x21) + samples


def make_humminbird(survey: Survey, folder: Path) -> Path:
    (folder / "line").mkdir()
    started_s = int(survey.pings[0].time_utc_s)
    dat = bytearray(64)
    dat[0] = 0xC1
    struct.pack_into(">I", dat, 20, started_s)
    (folder / "line.DAT").write_bytes(dat)
    for side, name in ((Side.PORT, "B002.SON"), (Side.STARBOARD, "B003.SON")):
        pings = []
        for ping in survey.pings:
            east, north = mercator(ping.lat_deg, ping.lon_deg)
            pings.append(
                son_ping(
                    ping.number,
                    round((ping.time_utc_s - started_s) * 1000),
                    ping.channel(side).samples.astype(np.uint8).tobytes(),
                    east=east,
                    north=north,
                    heading=round(ping.heading_deg * 10),
                    speed=round(ping.speed_mps * 10),
                    depth=round(ping.altitude_m * 10),
                )
            )
        (folder / "line" / name).write_bytes(b"".join(pings))
    return folder / "line.DAT"


def make_waterfall(survey: Survey, folder: Path, *, tiff: bool = False) -> Path:
    text = io.StringIO()
    columns = ("lat_deg", "lon_deg", "heading_deg", "altitude_m", "depth_m", "speed_mps", "pitch_deg", "roll_deg")
    writer = csv.writer(text)
    writer.writerow(("number", "time_utc", *columns, "slant_range_m"))
    for ping in survey.pings:
        writer.writerow((ping.number, ping.time_utc_s, *(getattr(ping, c) for c in columns), 25.0))
    (folder / "line.csv").write_text(text.getvalue())
    names = {}
    for side in Side:
        image = np.stack([ping.channel(side).samples for ping in survey.pings])
        image = image[:, ::-1] if side is Side.PORT else image
        names[side] = f"line.{side.value}.{'tif' if tiff else 'png'}"
        (write_tiff if tiff else write_png)(folder / names[side], np.ascontiguousarray(image))
    (folder / "line.waterfall.toml").write_text(
        f'sonar_id = "HDS"\nport = "{names[Side.PORT]}"\nstarboard = "{names[Side.STARBOARD]}"\n'
        'port_order = "farthest_first"\nnavigation = "line.csv"\npositions = "degrees"\n'
    )
    return folder / "line.waterfall.toml"


def lowrance_frame(version: int, offset: int, samples: bytes, channel: int = 5, **values: float) -> bytes:
    """Return the frame at an offset of an SL2 or SL3 file; values are fields in the units of the format.

    The size of its header, `header_bytes`, is by default that of SL2 or of `frame_version` 10 of SL3.
    """
    head = bytearray(int(values.get("header_bytes", 168 if version == 3 else 144)))
    size = len(head) + len(samples)
    places = {2: (28, 32, 34, 36, 40, 60, 100, 108, 120, 128, 140), 3: (8, 12, 44, 16, 20, 40, 84, 92, 104, 112, 124)}[
        version
    ]
    fields: tuple[tuple[str, tuple[float, ...]], ...] = (
        ("H", (size,)),
        ("H", (channel,)),
        ("I" if version == 3 else "H", (len(samples),)),
        ("I", (values.get("index", 0),)),
        ("ff", (values.get("low", -82.0), values.get("high", 82.0))),
        ("I", (values.get("time_s", 1_378_847_588),)),
        ("f", (values.get("speed", 0.0),)),
        ("ii", (values.get("east", 0), values.get("north", 0))),
        ("f", (values.get("course", 0.0),)),
        ("f", (values.get("heading", 0.0),)),
        ("i", (values.get("ms", 0),)),
    )
    struct.pack_into("<II", head, 0, offset & 0xFFFFFFFF, int(values.get("frame_version", 10)) if version == 3 else 0)
    for place, (kind, content) in zip(places, fields, strict=True):
        struct.pack_into("<" + kind, head, place, *content)
    return bytes(head) + samples


def make_lowrance(survey: Survey, folder: Path, version: int = 3, **fields: float) -> Path:
    """Write a composite recording; every ping follows a frame of the primary channel. `fields` are those of all."""
    polar_radius_m = 6_356_752.3142
    started_s = int(survey.pings[0].time_utc_s)
    content = bytearray(struct.pack("<4H", version, 2, 3200, 1))
    for ping in survey.pings:
        values = {
            "index": ping.number,
            "time_s": started_s,
            "speed": ping.speed_mps * 3600 / 1852,
            "east": round(math.radians(ping.lon_deg) * polar_radius_m),
            "north": round(polar_radius_m * math.asinh(math.tan(math.radians(ping.lat_deg)))),
            "course": math.radians(ping.course_deg or 0.0),
            "heading": 0.0 if ping.heading_deg is None else math.radians(ping.heading_deg) - 2 * math.pi,
            "ms": round((ping.time_utc_s - started_s) * 1000),
            **fields,
        }
        port, starboard = (ping.channel(side).samples.astype(np.uint8) for side in (Side.PORT, Side.STARBOARD))
        content += lowrance_frame(version, len(content), bytes(16), channel=0, **values)
        content += lowrance_frame(version, len(content), port[::-1].tobytes() + starboard.tobytes(), **values)
    path = folder / f"line.sl{version}"
    path.write_bytes(content)
    return path


def make_sl2(survey: Survey, folder: Path) -> Path:
    return make_lowrance(survey, folder, 2)


def jsf_message(number: int, subsystem: int, channel: int, samples: np.ndarray, **values: float) -> bytes:
    """Return a sonar message (80) of a JSF file; values are fields in the units of the format.

    Args:
        number: Ping number.
        subsystem: 20, 21 or 22 for side-scan.
        channel: 0 port, 1 starboard.
        samples: Envelope, shape (n,); or analytic, complex.
        values: `protocol` and the fields below; `start` and `end` of the chirp may have more than 16 bits.
    """
    head = bytearray(240)
    analytic = np.iscomplexobj(samples)
    start, end = (int(values.pop(name, default)) for name, default in (("start", 39_000), ("end", 41_000)))
    parts = np.stack([samples.real, samples.imag], axis=1) if analytic else samples
    fields: tuple[tuple[int, str, str, float], ...] = (
        (0, "i", "seconds", 1_378_847_588),
        (4, "I", "lead", 0),
        (16, "H", "msb", start >> 16 | end >> 16 << 4 | len(samples) >> 16 << 8),
        (18, "H", "lsb", 0),
        (20, "H", "lsb2", 0),
        (30, "H", "valid", 0b1001101101),
        (34, "h", "kind", int(analytic)),
        (80, "i", "x", 0),
        (84, "i", "y", 0),
        (88, "h", "unit", 2),
        (114, "H", "count", len(samples) & 0xFFFF),
        (116, "I", "interval_ns", 20_000),
        (136, "i", "depth", 0),
        (144, "i", "altitude", 0),
        (148, "f", "sound_speed", 1500.0),
        (156, "h", "year", 0),
        (158, "h", "day", 0),
        (168, "h", "weight", 0),
        (172, "H", "heading", 0),
        (174, "h", "pitch", 0),
        (176, "h", "roll", 0),
        (192, "h", "course", 0),
        (194, "h", "speed", 0),
        (200, "I", "day_ms", 0),
        (228, "f", "layback", 0),
    )
    struct.pack_into("<I", head, 8, number)
    struct.pack_into("<HH", head, 126, start & 0xFFFF, end & 0xFFFF)
    for offset, kind, name, default in fields:
        struct.pack_into("<" + kind, head, offset, values.get(name, default))
    content = bytes(head) + parts.astype("<i2" if analytic else "<u2").tobytes()
    return jsf_other(80, content, int(values.get("protocol", 0xB)), subsystem, channel)


def jsf_other(kind: int, content: bytes, protocol: int = 0xB, subsystem: int = 20, channel: int = 0) -> bytes:
    """Return a message of any type of a JSF file."""
    return struct.pack("<HBBHBBBBHi", 0x1601, protocol, 0, kind, 2, subsystem, channel, 0, 0, len(content)) + content


def make_jsf(survey: Survey, folder: Path) -> Path:
    """Write a recording with a message of another type after every ping."""
    with (folder / "line.jsf").open("wb") as file:
        for ping in survey.pings:
            seconds = int(ping.time_utc_s)
            values = {
                "seconds": seconds,
                "day_ms": round((ping.time_utc_s - seconds // 86_400 * 86_400) * 1000),
                "x": round(ping.lon_deg * 600_000),
                "y": round(ping.lat_deg * 600_000),
                "depth": round(ping.depth_m * 1000),
                "altitude": round(ping.altitude_m * 1000),
                "heading": round(ping.heading_deg * 100),
                "pitch": round(ping.pitch_deg * 32768 / 180),
                "roll": round(ping.roll_deg * 32768 / 180),
                "speed": round(ping.speed_mps * 3600 / 1852 * 10),
            }
            for number, side in enumerate(Side):
                channel = ping.channel(side)
                interval_ns = round(channel.slant_range_m / 750 / len(channel.samples) * 1e9)
                file.write(jsf_message(ping.number, 20, number, channel.samples, interval_ns=interval_ns, **values))
            file.write(jsf_other(2020, bytes(44)))
    return folder / "line.jsf"


def sdf_page(
    number: int, port: np.ndarray, starboard: np.ndarray, version: int = 3502, rest: bytes = b"", **values: float
) -> bytes:
    """Return a side-scan page of an SDF file with samples nearest first; values are fields in the format's units."""
    fields: tuple[tuple[int, str, str, float], ...] = (
        (20, "I", "count", max(len(port), len(starboard))),
        (32, "I", "range_m", 25),
        (36, "I", "speed", 0),
        (72, "I", "year", 2013),
        (76, "I", "month", 9),
        (80, "I", "day", 10),
        (84, "I", "hour", 21),
        (88, "I", "minute", 13),
        (92, "I", "second", 8),
        (140, "f", "heading", 0),
        (148, "d", "lat", 0),
        (156, "d", "lon", 0),
        (184, "I", "header", 512),
        (200, "f", "pitch", 0),
        (204, "f", "roll", 0),
        (208, "f", "depth", 0),
        (212, "f", "altitude", 0),
        (220, "f", "fraction", 0),
        (408, "I", "khz", 900),
    )
    head = bytearray(516)
    for offset, kind, name, default in fields:
        struct.pack_into("<" + kind, head, offset, values.get(name, default))
    samples = b"".join(struct.pack("<I", len(side)) + side.astype("<u4").tobytes() for side in (port, starboard))
    struct.pack_into("<I", head, 16, number)
    return sdf_other(version, bytes(head[12:]) + samples + rest)


def sdf_other(version: int, content: bytes) -> bytes:
    """Return a page of any version of an SDF file; the content follows the version."""
    return struct.pack("<III", 0xFFFFFFFF, len(content) + 8, version) + content


def make_sdf(survey: Survey, folder: Path) -> Path:
    """Write a recording with a page of another version after every ping."""
    with (folder / "line.sdf").open("wb") as file:
        for ping in survey.pings:
            when = datetime.fromtimestamp(ping.time_utc_s, UTC)
            port, starboard = (ping.channel(side) for side in (Side.PORT, Side.STARBOARD))
            values = {
                **{name: getattr(when, name) for name in ("year", "month", "day", "hour", "minute", "second")},
                "fraction": when.microsecond / 1e6,
                "range_m": round(port.slant_range_m),
                "speed": round(ping.speed_mps * 100),
                "heading": ping.heading_deg,
                "lat": math.radians(ping.lat_deg),
                "lon": math.radians(ping.lon_deg),
                "pitch": ping.pitch_deg,
                "roll": ping.roll_deg,
                "depth": ping.depth_m,
                "altitude": ping.altitude_m,
            }
            file.write(sdf_page(ping.number, port.samples, starboard.samples, **values))
            file.write(sdf_other(3503, bytes(44)))
    return folder / "line.sdf"


def svlog_packet(kind: int, payload: bytes) -> bytes:
    """Return a packet of an SVLOG file with its checksum."""
    packet = b"BR" + struct.pack("<HHBB", len(payload), kind, 1, 0) + payload
    return packet + struct.pack("<H", sum(packet) & 0xFFFF)


def svlog_session(timestamp: str = "2013-09-10T21:13:00+00:00", os_uptime: float | None = 1000.0) -> bytes:
    """Return the session packet (10)."""
    return svlog_packet(10, json.dumps({"timestamp": timestamp, "os_uptime": os_uptime}).encode())


def svlog_mavlink(kind: str, **values: float) -> bytes:
    """Return a packet (150) with a MAVLink message."""
    return svlog_packet(150, json.dumps({"header": {}, "message": {"type": kind, **values}}).encode())


def svlog_position(lat_deg: float, lon_deg: float, heading_deg: float, speed_mps: float, boot_ms: int = 1) -> bytes:
    """Return a packet with the message GLOBAL_POSITION_INT of a vehicle that moves ahead."""
    heading_rad = math.radians(heading_deg)
    return svlog_mavlink(
        "GLOBAL_POSITION_INT",
        lat=round(lat_deg * 1e7),
        lon=round(lon_deg * 1e7),
        hdg=round(heading_deg * 100),
        vx=round(speed_mps * 100 * math.cos(heading_rad)),
        vy=round(speed_mps * 100 * math.sin(heading_rad)),
        time_boot_ms=boot_ms,
    )


def svlog_profile(number: int, clock_ms: int, channel: int, results: np.ndarray, **values: float) -> bytes:
    """Return the profile (2198) of a transducer; values are fields in the units of the format.

    Args:
        number: Ping number.
        clock_ms: Clock of the sonar.
        channel: Channel number.
        results: Values of 16 bits between the least and the greatest decibel, shape (n,).
        values: `start_mm`, `length_mm`, `max_db`, `min_db`, `look_angle`, `heading`, `count`. The default look angle is
            that of port for channel 0, of starboard for channel 1.
    """
    head = struct.pack(
        "<5I3HBx6f",
        number,
        int(values.get("start_mm", 0)),
        int(values.get("length_mm", 25_000)),
        clock_ms,
        450_000,
        3,
        int(values.get("count", len(results))),
        15_000,
        channel,
        50e-6,
        10.0,
        values.get("max_db", 48.0),
        values.get("min_db", 0.0),
        values.get("look_angle", {0: -90.0, 1: 90.0}.get(channel, 0.0)),
        values.get("heading", 0.0),
    )
    return svlog_packet(2198, head + results.astype("<u2").tobytes())


def make_svlog(survey: Survey, folder: Path) -> Path:
    """Write a recording with a position before every ping; a sample of 0 is written as 1."""
    first_s = int(survey.pings[0].time_utc_s)
    stamp = datetime.fromtimestamp(first_s, UTC).isoformat()
    with (folder / "line.svlog").open("wb") as file:
        file.write(svlog_session(stamp))
        for ping in survey.pings:
            file.write(svlog_position(ping.lat_deg, ping.lon_deg, ping.heading_deg, ping.speed_mps))
            clock_ms = round((ping.time_utc_s - first_s + 1000) * 1000)
            for number, side in enumerate(Side):
                decibel = 20 * np.log10(np.maximum(ping.channel(side).samples.astype(float), 1))
                file.write(svlog_profile(ping.number, clock_ms, number, np.rint(decibel / 100 * 65535), max_db=100))
    return folder / "line.svlog"


MAKERS: dict[str, Callable[[Survey, Path], Path]] = {
    "xtf": make_xtf,
    "humminbird": make_humminbird,
    "jsf": make_jsf,
    "sdf": make_sdf,
    "sl2": make_sl2,
    "sl3": make_lowrance,
    "svlog": make_svlog,
    "waterfall": make_waterfall,
}
