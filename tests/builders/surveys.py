"""Survey files of every format with the content of a `Survey`."""

from __future__ import annotations

import csv
import io
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sonarpost.sonar.image_files import write_png, write_tiff
from sonarpost.sonar.survey import Side, Survey
from sonarpost.sonar.xtf_writer import write_xtf

RADIUS_M = 6_378_388.0


def make_xtf(survey: Survey, folder: Path) -> Path:
    write_xtf(survey, folder / "line.xtf")
    return folder / "line.xtf"


def mercator(lat_deg: float, lon_deg: float) -> tuple[int, int]:
    """Return Mercator coordinates in whole metres, as Humminbird recorders store them."""
    geocentric = math.atan(math.tan(math.radians(lat_deg)) / 1.0067642927)
    north_m = RADIUS_M * math.asinh(math.tan(geocentric))
    return round(math.radians(lon_deg) * RADIUS_M), round(north_m)


def son_ping(number: int, time_ms: int, samples: bytes, extra: bytes = b"", **values: int) -> bytes:
    """Return a ping of a SON file.

    Args:
        number: Number of the ping.
        time_ms: Time since the start of the recording.
        samples: Samples of 8 bits.
        extra: Additional header fields.
        values: Fields `east`, `north`, `heading`, `speed` and `depth` in the units of the format.
    """
    fields = struct.pack(">BIBI", 0x80, number, 0x81, time_ms)
    fields += struct.pack(">BiBi", 0x82, values.get("east", 0), 0x83, values.get("north", 0))
    fields += struct.pack(">BHH", 0x84, 1, values.get("heading", 0)) + struct.pack(
        ">BHH", 0x85, 1, values.get("speed", 0)
    )
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
        pings = b""
        for ping in survey.pings:
            east, north = mercator(ping.lat_deg, ping.lon_deg)
            pings += son_ping(
                ping.number,
                round((ping.time_utc_s - started_s) * 1000),
                ping.channel(side).samples.astype(np.uint8).tobytes(),
                east=east,
                north=north,
                heading=round(ping.heading_deg * 10),
                speed=round(ping.speed_mps * 10),
                depth=round(ping.altitude_m * 10),
            )
        (folder / "line" / name).write_bytes(pings)
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


MAKERS: dict[str, Callable[[Survey, Path], Path]] = {
    "xtf": make_xtf,
    "humminbird": make_humminbird,
    "waterfall": make_waterfall,
}
