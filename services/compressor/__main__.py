"""Run with `python -m services.compressor --config FILE`."""

import sys

from services.compressor.config import CompressorConfig
from services.compressor.service import CompressorService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(CompressorService, CompressorConfig)


if __name__ == "__main__":
    sys.exit(run())
