"""Fuzz the acoustic link, guided by coverage of the Python code (Atheris, on libFuzzer).

    python -m pip install 'sonarpost[fuzz]'       # x86-64 and Python 3.11 to 3.13: Atheris has no other wheels
    python tests/system/fuzz/run_atheris_link.py receiver -max_total_time=480
    python tests/system/fuzz/run_atheris_link.py driver -max_total_time=480

`receiver` is the v1 receiver, `driver` is the modem driver with the NMEA parser. `link_oracle` describes the checks.
Options with one dash are those of libFuzzer. The seeds are genuine traffic. Interesting inputs are stored in
`build/fuzz/link-…`. An input that fails is written to the current folder; `run_atheris_link.py receiver crash-…`
repeats it.
"""

from __future__ import annotations

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
    from builders.link_oracle import CHECKS, seeds

DEFAULTS = {"-max_len": 4096, "-timeout": 20, "-rss_limit_mb": 2048, "-print_final_stats": 1}


def main() -> None:
    """Run until libFuzzer ends the process."""
    name, *arguments = sys.argv[1:] or [""]
    if name not in CHECKS:
        sys.exit(f"run_atheris_link: {name!r} is not one of {', '.join(CHECKS)}")
    corpus = WORK / f"link-{name}"
    corpus.mkdir(parents=True, exist_ok=True)
    if not any(Path(argument).is_file() for argument in arguments):
        for number, seed in enumerate(seeds(name)):
            (corpus / f"seed-{number:03}").write_bytes(seed)
        arguments.append(str(corpus))

    def test_one_input(data: bytes) -> None:
        CHECKS[name](data)

    options = [f"{key}={value}" for key, value in DEFAULTS.items() if not any(a.startswith(key) for a in arguments)]
    atheris.Setup([sys.argv[0], *options, *arguments], test_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
