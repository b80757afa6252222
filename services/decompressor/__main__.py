"""Run with `python -m sonarpost.services.decompressor --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService

if __name__ == "__main__":
    sys.exit(main(DecompressorService, DecompressorConfig))
