"""Run with `python -m sonarpost.services.decompressor --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(DecompressorService, DecompressorConfig))
