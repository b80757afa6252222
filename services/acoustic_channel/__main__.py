"""Run with `python -m services.acoustic_channel --config FILE`."""

import sys

from services.acoustic_channel.config import AcousticChannelConfig
from services.acoustic_channel.service import AcousticChannelService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(AcousticChannelService, AcousticChannelConfig)


if __name__ == "__main__":
    sys.exit(run())
