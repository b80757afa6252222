"""The part that all fuzzers share; the modules under test must be imported before, with instrumentation."""

import sys
from pathlib import Path

import atheris

DEFAULTS = {"-timeout": 10, "-rss_limit_mb": 2048, "-print_final_stats": 1}


def fuzz(check, corpus, seeds, max_bytes, *arguments):
    """Run until libFuzzer ends the process, with the seeds unless an argument is a file to repeat."""
    corpus.mkdir(parents=True, exist_ok=True)
    options = [f"{name}={value}" for name, value in {**DEFAULTS, "-max_len": max_bytes}.items()]
    options = [option for option in options if not any(a.startswith(option.split("=")[0]) for a in arguments)]
    if not any(Path(argument).is_file() for argument in arguments):
        for number, seed in enumerate(seeds()):
            (corpus / f"seed-{number:04}").write_bytes(seed[:max_bytes])
        arguments = (*arguments, str(corpus))

    def test_one_input(data):
        check(data)

    atheris.Setup([sys.argv[0], *options, *arguments], test_one_input)
    atheris.Fuzz()
