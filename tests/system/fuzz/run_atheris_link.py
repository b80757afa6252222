"""Fuzz the acoustic link, guided by coverage of the Python code (Atheris, on libFuzzer).

    python -m pip install 'sonarpost[fuzz]'       # x86-64 and Python 3.11 to 3.13: Atheris has no other wheels
    python tests/system/fuzz/run_atheris_link.py receiver -max_total_time=480
    python tests/system/fuzz/run_atheris_link.py driver -max_total_time=480

`receiver` is the v1 receiver, `driver` is the modem driver with the NMEA parser. `link_oracle` describes the checks.
Options with one dash are those of libFuzzer. The seeds are genuine traffic. Interesting inputs are stored in
`build/fuzz/link-…`. An input that fails is written to the current folder; `run_atheris_link.py receiver crash-…`
repeats it.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
WORK = ROOT / "build" / "fuzz"
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "common"), str(ROOT)]

try:
    import atheris
except ImportError:
    sys.exit("run_atheris_link: Atheris is not installed here: python -m pip install 'sonarpost[fuzz]'")

with atheris.instrument_imports(include=["sonarpost.link", "sonarpost.modem"]):
    from builders.atheris_run import fuzz
    from builders.link_oracle import CHECKS, seeds


if __name__ == "__main__":
    name, *arguments = sys.argv[1:] or [""]
    if name not in CHECKS:
        sys.exit(f"run_atheris_link: {name!r} is not one of {', '.join(CHECKS)}")
    fuzz(CHECKS[name], WORK / f"link-{name}", lambda: seeds(name), 4096, *arguments)
