"""Run with `python -m sonarpost.services.acoustic_channel --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.acoustic_channel.config import AcousticChannelConfig
from sonarpost.services.acoustic_channel.service import AcousticChannelService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(AcousticChannelService, AcousticChannelConfig))
