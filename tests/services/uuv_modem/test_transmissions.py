"""uuv_modem: the times of its transmissions, from the modem's reports and without them."""

import time

import pytest
from builders.common import WAIT_S, eventually
from builders.records import outgoing_message

from sonarpost import keys, wire
from sonarpost.messages import Transmissions
from sonarpost.modem.interface import PacketFailed, PacketSent, TransmissionEnded, TransmissionStarted
from sonarpost.modem.micromodem import FailureReason
from sonarpost.services.uuv_modem.transmissions import KEPT_S, MAX_KEPT, TransmissionTimes

KEY = keys.acoustic_transmissions("uuv-1")


def sent(cycle_s):
    return PacketSent(1, 1, 1, (b"x",), (), 50.0, 50.0 + cycle_s, end_reported=False)


FAILED = PacketFailed(1, 1, 1, (b"x",), FailureReason.NO_TRANSMIT_START, maybe_sent=True)


class Clock:
    """Two clocks and the log that is under test."""

    def __init__(self):
        self.log = TransmissionTimes()
        self.utc_s, self.monotonic_s = 1000.0, 5.0

    def event(self, event, after_s=0.0):
        self.utc_s += after_s
        self.monotonic_s += after_s
        return self.log.on_event(event, self.utc_s, self.monotonic_s)

    @property
    def times(self):
        return [(each.start_utc_s, each.end_utc_s) for each in self.log.transmissions]


@pytest.fixture
def clock():
    return Clock()


def test_the_nominal_air_time_is_replaced_by_the_measured_one(clock):
    assert clock.event(TransmissionStarted(6.1))
    assert clock.times == [(1000.0, pytest.approx(1006.1))]
    assert clock.event(TransmissionEnded(6.1), 5.5)
    assert clock.times == [(1000.0, 1005.5)]
    assert not clock.event(sent(6.0), 0.1)


def test_a_lost_report_of_the_start_or_the_end(clock):
    clock.event(TransmissionEnded(6.1))
    assert clock.times == [(pytest.approx(993.9), pytest.approx(1000.0))]
    clock.event(TransmissionStarted(6.1), 100.0)
    clock.event(sent(8.0), 7.0)
    assert clock.times[1:] == [(1100.0, 1107.0)]


def test_a_packet_without_any_report_counts_from_the_start_of_its_cycle(clock):
    assert clock.event(sent(8.0))
    assert clock.times == [(992.0, 1000.0)]


def test_a_packet_that_failed_without_a_report_is_not_counted(clock):
    assert not clock.event(FAILED)
    clock.event(TransmissionStarted(6.1))
    clock.event(FAILED, 2.0)
    assert clock.times == [(1000.0, pytest.approx(1006.1))], "the modem may transmit to the end"


@pytest.mark.parametrize("step_s", [-3600.0, -3.0, 3600.0])
def test_a_step_of_the_clock_does_not_change_a_duration(step_s, clock):
    clock.event(TransmissionStarted(6.1))
    clock.utc_s += step_s
    clock.event(TransmissionEnded(6.1), 5.0)
    assert clock.times == [(1000.0, 1005.0)]


def test_old_transmissions_are_removed(clock):
    for _ in range(3):
        clock.event(sent(1.0), KEPT_S / 2)
    assert len(clock.times) == 3
    clock.event(sent(1.0), KEPT_S)
    assert len(clock.times) == 2
    for _ in range(MAX_KEPT + 5):
        clock.event(sent(0.5), 1.0)
    assert len(clock.times) == MAX_KEPT
    wire.encode(clock.log.record("uuv-1", clock.utc_s))


def test_a_clock_before_1970_and_a_report_after_hours_give_valid_records(clock):
    clock.utc_s = 1.0
    clock.event(sent(8.0))
    clock.event(TransmissionStarted(6.1), 10.0)
    clock.event(TransmissionEnded(6.1), 7200.0)
    record = clock.log.record("uuv-1", clock.utc_s)
    assert wire.decode(Transmissions, wire.encode(record), KEY) == record


def test_the_service_publishes_each_transmission_and_replies_to_a_query(
    start_service, start_vessel, runner, client, watch, modem_pair
):
    modem_pair.start()
    published = watch(KEY)
    start_vessel()
    start_service()
    source = runner.peer("uuv-1", "autonomy")
    before_s = time.time()
    source.send(keys.message_outgoing("uuv-1"), "uuv_modem", outgoing_message("m1"))

    def ended():
        records = [wire.decode(Transmissions, s.payload.to_bytes(), KEY) for s in published]
        return [r for r in records if r.transmissions and r.transmissions[-1].end_utc_s < r.time_utc_s + 0.1]

    eventually(lambda: bool(ended()), what="the record of an ended transmission")
    last = ended()[-1].transmissions[-1]
    assert before_s <= last.start_utc_s <= last.end_utc_s <= time.time()
    replies = [r.ok.payload.to_bytes() for r in client.get(KEY, timeout=WAIT_S) if r.ok is not None]
    (record,) = [wire.decode(Transmissions, payload, KEY) for payload in replies]
    assert last in record.transmissions
