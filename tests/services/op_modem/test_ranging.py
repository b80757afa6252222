"""Distances to the vehicles from pings: which vehicle and when, accepted answers, the record."""

import pytest
from builders.common import eventually

from sonarpost import keys, wire
from sonarpost.config import ModemTable
from sonarpost.errors import ConfigError
from sonarpost.messages import VehicleRange
from sonarpost.modem.interface import RangeMeasured, RequestDone, RequestFailed
from sonarpost.modem.micromodem.driver import DRIVER
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.op_modem.transmission import Ranging, TransmitGate

VESSEL = "vessel-1"
RANGE = keys.acoustic_range(VESSEL)


def ranging(**options):
    usual = {"port": "unused", "vehicles": {"3": "uuv-1", "5": "uuv-2"}, "ranging_period_s": 60.0}
    return Ranging(VESSEL, OpModemConfig(**(usual | options)))


def test_vehicles_are_pinged_in_turn_once_a_period():
    mine = ranging()
    assert mine.due_address(0.0) == 3
    mine.started(1, 3, 0.0)
    assert mine.due_address(61.0) is None, "the answer is awaited"
    assert not mine.ended(RequestDone(9, "ping", 3))
    assert mine.ended(RequestFailed(1, "ping", 3, "no answer"))
    assert [mine.due_address(at) for at in (59.0, 60.0)] == [None, 5]
    mine.started(2, 5, 60.0)
    assert mine.due_address(179.0) is None
    assert mine.due_address(180.0) == 3, "a ping whose end is not reported"


def test_without_period_or_vehicles_no_ping():
    assert ranging(ranging_period_s=0.0).due_address(0.0) is None
    assert ranging(vehicles={}).due_address(0.0) is None


def test_only_the_answer_to_the_ping_in_progress_is_a_distance():
    mine = ranging(sound_speed_mps=1480.0)
    answer = RangeMeasured(3, 1, 0.5)
    assert mine.measured(answer, 10.0) is None, "no ping"
    mine.started(1, 3, 0.0)
    for other in (RangeMeasured(5, 1, 0.5), RangeMeasured(3, 2, 0.5), RangeMeasured(3, 1, None)):
        assert mine.measured(other, 10.0) is None
    for travel_s in (-0.1, 100.1):
        assert mine.measured(RangeMeasured(3, 1, travel_s), 10.0) is None
    record = mine.measured(answer, 10.0)
    assert record is not None
    assert (record.vehicle_id, record.distance_m, record.measured_utc_s) == ("uuv-1", 740.0, 10.0)


def test_a_ping_waits_for_a_free_channel_without_limit():
    config = OpModemConfig(port="unused", holdoff_s=2.0, max_defer_s=10.0).for_modem(DRIVER.capabilities)
    gate = TransmitGate(config)
    gate.frame_received(100.0)
    assert [gate.is_free(at, 0.0, receiving=False) for at in (101.0, 102.0)] == [False, True]
    assert not gate.is_free(110.0, 0.0, receiving=True)
    for at in range(100, 200):
        gate.frame_received(float(at))
        assert not gate.is_free(at + 0.5, 0.0, receiving=False)
    gate.failed(300.0)
    assert not gate.is_free(301.0, 0.0, receiving=False)


def test_invalid_configuration_is_rejected(platform):
    with pytest.raises(ValueError, match="ranging_period_s"):
        OpModemConfig(port="unused", link="paper", ranging_period_s=10.0)
    other = platform(VESSEL).with_modem(ModemTable(driver="udp"))
    port = "udp://239.1.2.3:5000"
    with pytest.raises(ConfigError, match="ranging_period_s"):
        OpModemService(other, OpModemConfig(port=port, ranging_period_s=10.0))


def test_distance_is_published(begin, modem_pair, watch):
    samples = watch(RANGE)
    modem_pair.start()
    service = begin(ranging_period_s=0.5)
    eventually(lambda: len(samples) >= 2, what="two distances")
    record = wire.decode(VehicleRange, samples[0].payload.to_bytes(), RANGE)
    assert (record.vessel_id, record.vehicle_id, record.sound_speed_mps) == (VESSEL, "uuv-1", 1500.0)
    assert record.distance_m == pytest.approx(150.0, abs=2.0)
    assert record.distance_m == pytest.approx(1500.0 * record.travel_s, abs=0.01)
    assert service.health().counters["ranges_measured"] >= 2
    service.on_modem_event(RangeMeasured(9, 1, 0.5))
    assert service.health().counters["ranges_ignored"] == 1
