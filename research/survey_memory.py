"""`python -m research.survey_memory`: memory needed to read surveys, by file size.

    python -m research.survey_memory [--sizes-mb 100,2048] [--actions read,plot,detect,vehicle] [--samples N]
        [--folder DIR]

Writes XTF recordings of the given sizes: repeated simulated pings with consecutive numbers and times. A separate
process then reads each file ping by ping, draws it as a waterfall, or detects contacts in it, as `sonarpost detect` or
as the vehicle does (at most 20 contacts a file). Prints the peak resident memory and the time of the process. Deletes
the files afterwards.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import redirect_stdout
from datetime import UTC, datetime, timedelta
from io import StringIO
from pathlib import Path

from sonarpost.cli.main import main as main_command
from sonarpost.cli.survey.plot import draw_waterfall, reduce_survey
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.survey_detection import detect_in_survey
from sonarpost.sonar.readers import open_survey

HEADER_BYTES = 1024
PINGS = 200
NUMBER_OFFSET, TIME_OFFSET = 28, 14
START = datetime(2026, 1, 1, tzinfo=UTC)


def write_long(path: Path, size_bytes: int, samples: int) -> int:
    """Write a recording of about this size with pings of 2 x `samples`; return its number of pings."""
    write_xtf(simulate_survey(SurveySpec(seed=3, pings=PINGS, samples=samples)).survey, path)
    raw = path.read_bytes()
    ping_bytes = (len(raw) - HEADER_BYTES) // PINGS
    pings = [bytearray(raw[HEADER_BYTES + row * ping_bytes :][:ping_bytes]) for row in range(PINGS)]
    count = size_bytes // ping_bytes
    with path.open("wb") as file:
        file.write(raw[:HEADER_BYTES])
        for number in range(count):
            ping = pings[number % PINGS]
            when = START + timedelta(milliseconds=100 * number)
            ping[NUMBER_OFFSET : NUMBER_OFFSET + 4] = number.to_bytes(4, "little")
            stamp = (when.month, when.day, when.hour, when.minute, when.second, when.microsecond // 10_000)
            ping[TIME_OFFSET : TIME_OFFSET + 8] = when.year.to_bytes(2, "little") + bytes(stamp)
            file.write(ping)
    return count


def process(path: Path, action: str) -> None:
    """Perform one action on a file; print peak memory and time."""
    start = time.perf_counter()
    if action == "detect":
        with redirect_stdout(StringIO()) as output:
            main_command(["detect", str(path), "--max-contacts", "20", "--json"])
        count = len(json.loads(output.getvalue())["files"][0]["contacts"])
    elif action == "vehicle":
        count = detect_in_survey(path, "0" * 64, "uuv-1", AtdStubConfig(max_contacts=20)).contact_count
    else:
        with open_survey(path) as source:
            if action == "read":
                count = sum(1 for _ in source.pings())
            else:
                count = draw_waterfall(reduce_survey(source, over_ground=False), "long", over_ground=False).height
    duration_s = time.perf_counter() - start
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    size_mb = path.stat().st_size / 1e6
    unit = {"read": "pings", "plot": "rows", "detect": "contacts", "vehicle": "contacts"}[action]
    print(f"{size_mb:8.0f} MB  {action:7} {count:8} {unit:8} {peak_mib:6.0f} MiB peak {duration_s:7.1f} s", flush=True)


def main() -> None:
    """Measure every size."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--sizes-mb", default="20,100,2048", help="(default: %(default)s)")
    parser.add_argument("--actions", default="read,plot", help="of read, plot, detect, vehicle (default: %(default)s)")
    parser.add_argument(
        "--samples",
        type=int,
        default=1024,
        help="samples of a ping on each side: longer pings are processed in less time (default: %(default)s)",
    )
    parser.add_argument(
        "--folder", type=Path, help="where the files are written (default: the system's temporary folder)"
    )
    parser.add_argument("--process", nargs=2, metavar=("FILE", "ACTION"), help=argparse.SUPPRESS)
    parsed = parser.parse_args()
    if parsed.process:
        process(Path(parsed.process[0]), parsed.process[1])
        return
    with tempfile.TemporaryDirectory(dir=parsed.folder) as folder:
        for size_mb in map(int, parsed.sizes_mb.split(",")):
            path = Path(folder) / "long.xtf"
            write_long(path, size_mb * 1_000_000, parsed.samples)
            for action in parsed.actions.split(","):
                subprocess.run(
                    [sys.executable, "-m", "research.survey_memory", "--process", str(path), action], check=True
                )


if __name__ == "__main__":
    main()
