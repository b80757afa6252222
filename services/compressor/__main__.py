"""Run with `python -m sonarpost.services.compressor --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.service import CompressorService


def run() -> int:
    """Run the service until it is stopped; return the exit status."""
    return main(CompressorService, CompressorConfig)


if __name__ == "__main__":
    sys.exit(run())
