"""Run with `python -m sonarpost.services.compressor --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.service import CompressorService

if __name__ == "__main__":
    sys.exit(main(CompressorService, CompressorConfig))
