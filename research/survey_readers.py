"""`python -m research.survey_readers`: what the survey readers read, how exactly, how fast, and with how much memory.

    python -m research.survey_readers [--mb 100] [--formats jsf,svlog] [--folder DIR]

For each format writes a recording of this size, by repetition of simulated pings, and reads it twice in a separate
process, as opening and reading do. Prints its pings, the greatest distance of a position from the one that was written,
the peak resident memory of the process, and the speed of reading. Waterfall images are decoded whole, so their
number of pings is limited to 60,000. Deletes the files afterwards.
"""

import argparse
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from sonarpost.sonar.geometry import Position, offset_between_m, offset_position
from sonarpost.sonar.readers import open_survey, recording_parts
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))  # the writers of the formats are those of the tests
from builders.surveys import MAKERS  # type: ignore[import-not-found]

SAMPLES = 1000
MAX_IMAGE_ROWS = 60_000
START = Position(48.4, -68.8)
START_UTC_S = 1_500_000_000.0
BEARING_DEG, STEP_M, STEP_S = 40.0, 0.1, 0.1


def place(row: int) -> Position:
    """Return the position of a ping: a line there and back, 1 km long."""
    along_m = abs((row * STEP_M + 1000) % 2000 - 1000)
    return offset_position(START, BEARING_DEG, along_m)


def survey_of(count: int) -> Survey:
    """Return a survey of `count` pings with the samples of 16."""
    rng = np.random.default_rng(0)
    echoes = rng.integers(1, 255, (16, 2, SAMPLES), dtype=np.uint8)
    channels = [
        tuple(ChannelPing(side, echoes[n, i], 25.0, 600_000.0) for i, side in enumerate(Side)) for n in range(16)
    ]
    pings = []
    for row in range(count):
        here = place(row)
        pings.append(
            Ping(
                number=row,
                time_utc_s=START_UTC_S + row * STEP_S,
                channels=channels[row % 16],
                lat_deg=here.lat_deg,
                lon_deg=here.lon_deg,
                heading_deg=BEARING_DEG,
                altitude_m=6.0,
                depth_m=14.0,
                speed_mps=1.0,
                pitch_deg=0.5,
                roll_deg=-0.5,
            )
        )
    return Survey(Path("line"), "HDS", "line", tuple(pings))


def size_bytes(path: Path) -> int:
    """Return the size of all files of a recording."""
    return sum(part.stat().st_size for part in recording_parts(path))


def write(kind: str, size_mb: int, folder: Path) -> Path:
    """Write a recording of about this size; return its path."""
    trial = folder / "trial"
    trial.mkdir()
    per_ping = size_bytes(MAKERS[kind](survey_of(100), trial)) / 100
    pings = int(size_mb * 1e6 / per_ping)
    path: Path = MAKERS[kind](survey_of(min(pings, MAX_IMAGE_ROWS) if kind == "waterfall" else pings), folder)
    return path


def measure(kind: str, path: Path) -> None:
    """Read a recording; print a line of the table."""
    start = time.perf_counter()
    worst_m = 0.0
    with open_survey(path) as source:
        opened_s = time.perf_counter() - start
        start = time.perf_counter()
        for count, ping in enumerate(source.pings()):
            if count % 100 == 0:
                worst_m = max(worst_m, off_m(count, ping.lat_deg, ping.lon_deg))
        read_s = time.perf_counter() - start
        pings = source.info.ping_count
    # Not getrusage: its peak includes that of the process that started this one.
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak_mib = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024
    size_mb = size_bytes(path) / 1e6
    print(
        f"| {kind} | {size_mb:.0f} MB | {pings:,} | {worst_m:.2f} m | {peak_mib:.0f} MiB "
        f"| {size_mb / opened_s:.0f} | {size_mb / read_s:.0f} |",
        flush=True,
    )


def off_m(row: int, lat_deg: float | None, lon_deg: float | None) -> float:
    """Return the distance of a position from the written one; infinite without a position."""
    if lat_deg is None or lon_deg is None:
        return math.inf
    return math.hypot(*offset_between_m(place(row), Position(lat_deg, lon_deg)))


def main() -> None:
    """Measure every format."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--mb", type=int, default=100, help="size of each recording (default: %(default)s)")
    parser.add_argument("--formats", default=",".join(sorted(MAKERS)), help="(default: %(default)s)")
    parser.add_argument("--folder", type=Path, help="where the files are written (default: the temporary folder)")
    parser.add_argument("--measure", nargs=2, metavar=("FORMAT", "FILE"), help=argparse.SUPPRESS)
    parsed = parser.parse_args()
    if parsed.measure:
        measure(parsed.measure[0], Path(parsed.measure[1]))
        return
    print("| format | file | pings | position error | peak memory | MB/s opened | MB/s read |")
    print("|---|---|---|---|---|---|---|")
    for kind in parsed.formats.split(","):
        with tempfile.TemporaryDirectory(dir=parsed.folder) as folder:
            path = write(kind, parsed.mb, Path(folder))
            command = [sys.executable, "-m", "research.survey_readers", "--measure", kind, str(path)]
            subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
