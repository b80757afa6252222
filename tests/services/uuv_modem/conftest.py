"""Fixtures of these tests: the service, and a service that sends it records."""

import pytest

from sonarpost.delivery.store import Store
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService


@pytest.fixture
def start_service(runner, platform, modem_pair):
    """Start uuv_modem with short delays and the given options."""

    def start(platform_config=None, **options):
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


@pytest.fixture
def start_vessel(runner, platform, modem_pair):
    """Start op_modem of vessel-1 with the given options; it authenticates frames if there is a key file."""

    def start(*, key_file=None, **options):
        usual = {"port": modem_pair.port(modem_pair.VESSEL), "vehicles": {"3": "uuv-1"}, "status_interval_s": 1.0}
        auth = "none" if key_file is None else "key"
        there = platform("vessel-1").model_copy(update={"acoustic_auth": auth, "acoustic_key_file": key_file})
        return runner.start(OpModemService(there, OpModemConfig(**(usual | options))))

    return start


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "uuv_modem.db")
    yield store
    store.close()
