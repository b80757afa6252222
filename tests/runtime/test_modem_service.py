"""Health and log of a service with a modem that does not transmit, reports too much or sends garbage."""

import fcntl
import logging
import os
import pty
from types import SimpleNamespace

import pytest
from builders.common import eventually
from builders.fake_modem import FakeModem

from sonarpost.modem.interface import SentenceRejected
from sonarpost.modem.micromodem import MicroModem, MicroModemConfig
from sonarpost.runtime.modem_service import ModemServiceConfig, ServiceModem
from sonarpost.runtime.service import Service

PORT = "/dev/ttyUSB0"


class WithModem(Service[ModemServiceConfig]):
    """A service that has a modem and nothing else."""

    NAME = "uuv_modem"

    def __init__(self, platform, config):
        super().__init__(platform, config.for_platform(platform))
        self.modem = ServiceModem(self, lambda _: None)

    def handle(self, key, record, effects):
        raise NotImplementedError

    def on_start(self):
        self.modem.start()

    def on_stop(self):
        self.modem.stop()

    def degraded_reason(self):
        return self.modem.degraded_reason()

    def warning(self):
        return self.modem.warning()


class Connected:
    """A service, not started, whose driver's events come from a modem on simulated time."""

    def __init__(self, service):
        self.service = service
        self.modem = FakeModem(MicroModem(MicroModemConfig(address=3)))
        self._seen = 0
        # The port is not opened: the service has an open one and the driver of the simulated modem instead.
        service.modem._port = SimpleNamespace(is_open=True, error="")
        service.modem._driver = self.modem.driver
        self.modem.driver.port_opened(0.0)
        self.run(5.0)

    def run(self, seconds):
        until_s = self.modem.now + seconds
        while self.modem.now < until_s:
            self.modem.run(min(until_s, self.modem.now + 1.0))
            for event in self.modem.events[self._seen :]:
                self.service.modem.report(event)
            self._seen = len(self.modem.events)

    def send(self):
        if not self.modem.driver.queued:
            self.modem.driver.send_packet(1, 4, [b"x"], now=self.modem.now)

    def keep_sending(self, seconds):
        for _ in range(round(seconds)):
            self.send()
            self.run(1.0)


@pytest.fixture
def connected(platform):
    service = WithModem(platform("uuv-1"), ModemServiceConfig(port=PORT, address=3))
    yield Connected(service)
    service.stop()


def test_service_whose_port_is_in_use_is_degraded_until_the_port_is_free(platform):
    master, slave = pty.openpty()
    path = os.ttyname(slave)
    fcntl.flock(slave, fcntl.LOCK_EX)
    service = WithModem(platform("uuv-1"), ModemServiceConfig(port=path, address=3))
    try:
        assert service.start()
        eventually(lambda: "in use by" in service.health().detail)
        health = service.health()
        assert health.state == "degraded"
        assert health.detail.startswith(f"{path}: in use by ")
        assert f"(process {os.getpid()})" in health.detail
        os.close(slave)
        eventually(lambda: service.health().detail.startswith(f"{path}: no reply from the modem yet"))
    finally:
        service.stop()
        os.close(master)


def lines(caplog, message):
    return [record for record in caplog.records if record.message == message]


def test_modem_that_rejects_every_packet_is_in_health_until_it_transmits(connected, caplog):
    caplog.set_level(logging.INFO)
    connected.modem.refuses_cycles = True
    assert connected.service.health().state == "ok"
    connected.keep_sending(20.0)
    health = connected.service.health()
    assert health.state == "degraded"
    assert health.detail.startswith(f"{PORT}: the modem does not transmit: the modem rejected the command")
    assert health.counters["modem_transmit_failures"] == 1
    assert health.counters["modem_restarts_requested"] == 1
    assert len(lines(caplog, "Modem does not transmit")) == len(lines(caplog, "Restarting the modem")) == 1
    connected.modem.refuses_cycles = False
    connected.keep_sending(20.0)
    assert connected.service.health().state == "ok"
    [recovered] = lines(caplog, "Modem transmits again")
    assert vars(recovered)["fields"]["after_s"] > 10.0


def test_channel_that_is_never_free_is_in_health(connected, caplog):
    caplog.set_level(logging.INFO)
    for n in range(60):
        connected.modem.schedule(n * 5.0, lambda: connected.modem.send("CARXP", 1))
    connected.keep_sending(60.0)
    health = connected.service.health()
    assert health.state == "ok", "the service transmits"
    assert f"{PORT}: the modem reports a busy channel without a pause" in health.detail
    assert health.counters["carrier_sense_ignored"] == 1
    assert connected.modem.transmitted
    connected.run(400.0)
    assert "busy channel" not in connected.service.health().detail
    assert len(lines(caplog, "Modem reports a free channel again")) == 1


def test_unreported_transmissions_are_in_health(connected):
    connected.modem.settings |= {"TXP": "0", "TXF": "0", "XST": "0"}
    connected.keep_sending(60.0)
    health = connected.service.health()
    assert health.counters["packets_unreported"] >= 3
    assert f"{PORT}: the modem does not report the end of transmissions" in health.detail
    connected.modem.settings |= {"TXP": "1", "TXF": "1", "XST": "1"}
    connected.keep_sending(30.0)
    assert "does not report" not in connected.service.health().detail


def test_log_lines_on_garbage_are_limited(connected, caplog):
    for n in range(5000):
        for event in connected.modem.driver.receive(b"\xff\x00$garbage %d\r\n" % n, 5.0):
            connected.service.modem.report(event)
    rejected = connected.service.health().counters["sentences_rejected"]
    assert rejected >= 5000
    connected.service._health.flush_logs(stopping=True)
    written = lines(caplog, "Line from the modem rejected")
    assert len(written) <= 10
    assert len(written) + sum(vars(r)["fields"].get("suppressed", 0) for r in written) == rejected
    assert not connected.modem.events_of(SentenceRejected)
