"""Run with `python -m sonarpost.services.compressor --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.service import CompressorService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(CompressorService, CompressorConfig))
