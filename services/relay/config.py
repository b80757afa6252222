"""Configuration of the relay: the `[relay]` table."""

from sonarpost.runtime.config import ServiceConfig


class RelayConfig(ServiceConfig):
    """The relay takes everything it needs from `[platform]`."""
