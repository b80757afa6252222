"""Run with `python -m sonarpost.services.acoustic_channel --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.acoustic_channel.config import AcousticChannelConfig
from sonarpost.services.acoustic_channel.service import AcousticChannelService

if __name__ == "__main__":
    sys.exit(main(AcousticChannelService, AcousticChannelConfig))
