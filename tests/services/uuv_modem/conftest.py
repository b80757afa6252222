"""Fixtures of these tests: the service, and a service that sends it records."""

from __future__ import annotations

import pytest

from sonarpost.config import PlatformConfig
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService


@pytest.fixture
def start_service(runner, platform, modem_pair):
    """Start uuv_modem with short delays and the given options."""

    def start(platform_config: PlatformConfig | None = None, **options):
        defaults = {
            "port": modem_pair.port(modem_pair.VEHICLE),
            "rate": 1,
            "retry_s": 0.05,
            "rx_window_s": 0.0,
            "group_delay_s": 0.3,
            "holdoff_s": 0.15,
            "queue_interval_s": 0.1,
        }
        config = UuvModemConfig(**(defaults | options))
        return runner.start(UuvModemService(platform_config or platform("uuv-1"), config))

    return start


@pytest.fixture
def compressor(runner):
    """A service of the vehicle that sends records to uuv_modem."""
    return runner.peer("uuv-1", "compressor")
