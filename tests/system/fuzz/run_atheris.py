"""Fuzz the decoding of codec streams, guided by coverage of the Python code (Atheris, on libFuzzer).

    python -m pip install 'sonarpost[fuzz]'       # x86-64 and Python 3.11 to 3.13: Atheris has no other wheels
    python tests/system/fuzz/run_atheris.py --codecs emb -max_total_time=180

Options with one dash are those of libFuzzer. Without options it runs until it finds a failure or is stopped. The seeds
are golden and new streams, complete and as bodies after a valid header. Interesting inputs are stored in
`build/fuzz/<codecs>`. An input that fails is written to the current folder; `run_atheris.py --codecs emb crash-…`
repeats it.

The machine code of emb is compiled with bounds checks, so that an index outside an array is an error. It is not
instrumented, nor are the libraries of the other codecs. libFuzzer limits each input to 10 s and the process to 2 GiB.
"""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[3]
WORK = ROOT / "build" / "fuzz"
os.environ.setdefault("NUMBA_BOUNDSCHECK", "1")
os.environ.setdefault("NUMBA_CACHE_DIR", str(WORK / "numba"))
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "common")]

try:
    import atheris
except ImportError:
    sys.exit("run_atheris: Atheris is not installed here: python -m pip install 'sonarpost[fuzz]'")

# Functions compiled by numba must not be instrumented.
COMPILED = [
    "sonarpost.codec.vq.tile_search",
    *(
        f"sonarpost.codec.emb.{name}"
        for name in ("decode", "encode", "kernel", "perceptual_weights", "rate_distortion_opt", "transform")
    ),
]

with atheris.instrument_imports(include=["sonarpost", "fuzz"], exclude=COMPILED):
    from builders.atheris_run import fuzz
    from builders.codec_oracle import check, codec_for, codec_ids, stream_of
    from builders.fuzz_seeds import as_input, golden_streams, new_streams

    from sonarpost.codec.emb import codec as emb  # noqa: F401
    from sonarpost.codec.vq import codec as vq  # noqa: F401


def main() -> None:
    """Run until libFuzzer ends the process."""
    arguments = sys.argv[1:]
    names = None
    if "--codecs" in arguments:
        place = arguments.index("--codecs")
        names = arguments[place + 1].split(",")
        del arguments[place : place + 2]
    ids = codec_ids(names)
    for codec_id in ids:
        codec_for(codec_id)  # loading is not part of the time of an input

    def seeds() -> Iterator[bytes]:
        for stream in (*golden_streams(ids), *new_streams(ids)):
            yield from (as_input(stream, flags, ids) for flags in range(4))

    def check_input(data: bytes) -> None:
        check(*stream_of(data, ids), ids)

    fuzz(check_input, WORK / ("-".join(names) if names else "all"), seeds, 1200, *arguments)


if __name__ == "__main__":
    main()
