"""Run with `python -m sonarpost.services.acoustic_channel --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.acoustic_channel.config import AcousticChannelConfig
from sonarpost.services.acoustic_channel.service import AcousticChannelService


def run() -> int:
    """Run the service until it is stopped; return the exit status."""
    return main(AcousticChannelService, AcousticChannelConfig)


if __name__ == "__main__":
    sys.exit(run())
