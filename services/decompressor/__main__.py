"""Run with `python -m services.decompressor --config FILE`."""

import sys

from services.decompressor.config import DecompressorConfig
from services.decompressor.service import DecompressorService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(DecompressorService, DecompressorConfig)


if __name__ == "__main__":
    sys.exit(run())
