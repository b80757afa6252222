"""Configuration of the channel emulator service: the `[acoustic_channel]` table."""

from sonarpost.extensions.simulation.channel.config import EmulatorConfig


class AcousticChannelConfig(EmulatorConfig):
    """The `[acoustic_channel]` table; `modem` and `transponder` are arrays of tables."""
