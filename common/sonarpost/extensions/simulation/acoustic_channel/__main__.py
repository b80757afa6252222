"""Run with `python -m sonarpost.extensions.simulation.acoustic_channel --config FILE`."""

from sonarpost.extensions.simulation.acoustic_channel.config import AcousticChannelConfig
from sonarpost.extensions.simulation.acoustic_channel.service import AcousticChannelService
from sonarpost.runtime.process import main
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(AcousticChannelService, AcousticChannelConfig))
