"""Fixtures of these tests: the service with short delays, its folder and its consumer."""

import pytest
from builders.joined_surveys import FEW_CANDIDATES

from sonarpost import keys
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.service import AtdStubService


@pytest.fixture
def incoming(tmp_path):
    folder = tmp_path / "incoming"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def start_service(runner, platform, incoming):
    """Start atd_stub of uuv-1, quick and without a limit of contacts in flight, with the given options."""

    def start(**options):
        usual = {"input_dir": incoming, "poll_s": 0.02, "settle_s": 0.0, "max_in_flight": 0, "detector": FEW_CANDIDATES}
        return runner.start(AtdStubService(platform("uuv-1"), AtdStubConfig(**(usual | options))))

    return start


@pytest.fixture
def compressor(runner):
    return runner.peer("uuv-1", "compressor", {keys.contact_detected("uuv-1"): Snippet})


@pytest.fixture
def counter():
    return lambda service, name: service.health().counters.get(name, 0)


@pytest.fixture
def gauge():
    return lambda service, name: service.health().gauges[name]


@pytest.fixture
def lines(caplog):
    """Return the fields of the log lines with a message."""
    caplog.set_level("INFO")
    return lambda message: [record.fields for record in caplog.records if record.message == message]
