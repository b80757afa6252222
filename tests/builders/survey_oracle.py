"""Check of the survey readers with arbitrary bytes: they raise SurveyFileError or return plausible pings.

The coverage-guided fuzzer (`run_atheris.py`) and the tests of the default suite use it.
"""

import math
import struct
from collections.abc import Collection
from pathlib import Path

import numpy as np

from builders.surveys import MAKERS, small_survey
from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import georeference
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.survey import Ping, Survey

FILES = (
    ("xtf", "line.xtf"),
    ("humminbird", "line.DAT"),
    ("humminbird", "line/B002.SON"),
    ("waterfall", "line.waterfall.toml"),
    ("waterfall", "line.csv"),
    ("waterfall", "line.port.png"),
    ("sl2", "line.sl2"),
    ("sl3", "line.sl3"),
    ("jsf", "line.jsf"),
    ("svlog", "line.svlog"),
    ("sdf", "line.sdf"),
)
"""Format and file; the first byte of an input selects one, of the formats in use."""
MAX_PINGS = 2000
OPTIONS = SurveyOptions(projected_crs="EPSG:32619", humminbird_depth_as_altitude=True)


def tiny_survey(pings: int = 3, samples: int = 12) -> Survey:
    """Return a few pings of a few samples."""
    return small_survey(pings=pings, samples=samples)


class Readers:
    """Valid recordings in a folder, of every format or the given ones; `check` replaces one file at a time."""

    def __init__(self, root: Path, kinds: Collection[str] = tuple(MAKERS)) -> None:
        self._opened: dict[str, Path] = {}
        for kind in kinds:
            (root / kind).mkdir()
            self._opened[kind] = MAKERS[kind](tiny_survey(), root / kind)
        self._kinds = [kind for kind, _ in FILES if kind in self._opened]
        self._files = [root / kind / name for kind, name in FILES if kind in self._opened]
        self._valid = [path.read_bytes() for path in self._files]

    def seeds(self) -> list[bytes]:
        """Return valid inputs for each file, and one of the first file whose end is cut."""
        valid = [bytes([number]) + content for number, content in enumerate(self._valid)]
        solix = [  # its DAT file differs from that of the other seed
            bytes([number]) + bytes(20) + struct.pack("<I", 1_600_000_000) + bytes(72)
            for number, path in enumerate(self._files)
            if path.name == "line.DAT"
        ]
        return [*valid, *solix, valid[0][:-100]]

    def check(self, data: bytes) -> str:
        """Read an input; return "rejected" or "read".

        Raises:
            AssertionError: A value of a ping is impossible.
            Exception: The reader raised an exception other than SurveyFileError.
        """
        number = (data[0] if data else 0) % len(self._files)
        self._files[number].write_bytes(data[1:])
        try:
            return self._read(self._opened[self._kinds[number]])
        finally:
            self._files[number].write_bytes(self._valid[number])

    def _read(self, path: Path) -> str:
        try:
            with open_survey(path, OPTIONS) as source:
                count = 0
                for ping in source.pings():
                    check_ping(ping)
                    count += 1
                assert count == source.info.ping_count <= MAX_PINGS
        except SurveyFileError:
            return "rejected"
        return "read"


def check_ping(ping: Ping) -> None:
    """Raise AssertionError if a value of the ping is impossible."""
    assert math.isfinite(ping.time_utc_s)
    assert (ping.lat_deg is None) == (ping.lon_deg is None)
    assert ping.lat_deg is None or ping.lon_deg is None or (abs(ping.lat_deg) <= 90 and abs(ping.lon_deg) <= 180)
    assert ping.heading_deg is None or 0 <= ping.heading_deg < 360
    assert ping.altitude_m is None or 0 < ping.altitude_m <= 11_000
    assert ping.speed_mps is None or 0 <= ping.speed_mps <= 50
    assert ping.pitch_deg is None or abs(ping.pitch_deg) <= 90
    for channel in ping.channels:
        assert channel.samples.ndim == 1
        assert channel.samples.size
        assert math.isfinite(channel.slant_range_m)
        assert channel.slant_range_m > 0
        assert np.isfinite(channel.echo()).all()
        found = georeference(ping, channel.side, len(channel.samples) - 1, OPTIONS)
        assert found is None or (abs(found.position.lat_deg) <= 90.5 and math.isfinite(found.sigma_m))
