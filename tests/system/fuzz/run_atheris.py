"""Fuzz decoders and readers, guided by coverage of the Python code (Atheris, on libFuzzer).

    python -m pip install 'sonarpost[fuzz]'       # x86-64 and Python 3.11 to 3.13: Atheris has no other wheels
    python tests/system/fuzz/run_atheris.py codecs --only=emb -max_total_time=180
    python tests/system/fuzz/run_atheris.py surveys --only=jsf -max_total_time=180
    python tests/system/fuzz/run_atheris.py receiver -max_total_time=480
    python tests/system/fuzz/run_atheris.py driver -max_total_time=480

`receiver` is the v1 receiver, `driver` is the modem driver with the NMEA parser. `--only` limits a run to some codecs
or formats of surveys, separated by commas. Options with one dash are those of libFuzzer, which limits each input to 10
s and the process to 2 GiB; without options it runs until it finds a failure or is stopped. The oracles in `builders`
describe the inputs and the checks. The seeds are golden and new streams, valid recordings, and genuine traffic.
Interesting inputs are stored in a folder of `build/fuzz`. An input that fails is written to the current folder;
`run_atheris.py codecs --only=emb crash-…` repeats it.

The machine code of emb is compiled with bounds checks, so that an index outside an array is an error. It is not
instrumented, nor are the libraries of the other codecs.
"""

import os
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[3]
WORK = ROOT / "build" / "fuzz"
os.environ.setdefault("NUMBA_BOUNDSCHECK", "1")
os.environ.setdefault("NUMBA_CACHE_DIR", str(WORK / "numba"))
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "common"), str(ROOT)]

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
DEFAULTS = {"-timeout": 10, "-rss_limit_mb": 2048, "-print_final_stats": 1}


def codecs(names):
    """Return check, seeds and maximum length of an input."""
    from builders.codec_oracle import as_input, check, codec_for, codec_ids, golden_streams, new_streams, stream_of

    from sonarpost.codec.emb import codec as emb  # noqa: F401
    from sonarpost.codec.vq import codec as vq  # noqa: F401

    ids = codec_ids(names)
    for codec_id in ids:
        codec_for(codec_id)  # loading is not part of the time of an input
    streams = (*golden_streams(ids), *new_streams(ids))
    return (
        lambda data: check(*stream_of(data, ids), ids),
        (as_input(stream, flags, ids) for stream in streams for flags in range(4)),
        1200,
    )


def surveys(names):
    """Return the same for recordings; the first byte of an input selects the file (`survey_oracle.FILES`)."""
    from builders.survey_oracle import Readers

    # Not deleted, because libFuzzer ends the process.
    folder = Path(tempfile.mkdtemp(prefix="survey-", dir=WORK))
    readers = Readers(folder, names) if names else Readers(folder)
    return readers.check, readers.seeds(), 4096


def link(target):
    """Return the same for the acoustic link."""
    from builders import modem_fuzz, v1_fuzz

    fuzzed = {"receiver": v1_fuzz, "driver": modem_fuzz}[target]
    return fuzzed.check, fuzzed.seeds(), 4096


def main():
    """Run until libFuzzer ends the process, with the seeds unless an argument is a file to repeat."""
    instrumented = {
        "codecs": ["sonarpost"],
        "surveys": ["sonarpost.sonar"],
        "receiver": ["sonarpost.link"],
        "driver": ["sonarpost.modem"],
    }
    target, *arguments = sys.argv[1:] or [""]
    if target not in instrumented:
        sys.exit(f"run_atheris: {target!r} is not one of {', '.join(instrumented)}")
    [only] = [argument for argument in arguments if argument.startswith("--only=")] or [""]
    names = only.removeprefix("--only=").split(",") if only else None
    corpus = WORK / "-".join([target, *(names or ())])
    corpus.mkdir(parents=True, exist_ok=True)
    with atheris.instrument_imports(include=instrumented[target], exclude=COMPILED):
        makers = {"codecs": codecs, "surveys": surveys}
        check, seeds, max_bytes = makers[target](names) if target in makers else link(target)
    arguments = [argument for argument in arguments if argument != only]
    options = [f"{name}={value}" for name, value in {**DEFAULTS, "-max_len": max_bytes}.items()]
    options = [option for option in options if not any(a.startswith(option.split("=")[0]) for a in arguments)]
    if not any(Path(argument).is_file() for argument in arguments):
        for number, seed in enumerate(seeds):
            (corpus / f"seed-{number:04}").write_bytes(seed[:max_bytes])
        arguments.append(str(corpus))

    def test_one_input(data):
        check(data)

    atheris.Setup([sys.argv[0], *options, *arguments], test_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
