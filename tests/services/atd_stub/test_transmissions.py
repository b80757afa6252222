"""atd_stub: masking of pings during the transmissions of the vehicle's own modem."""

import logging
import time
from dataclasses import replace

import msgpack
import pytest
from builders.common import eventually
from builders.joined_surveys import Box, near, survey_of
from builders.xtf import write_xtf

from sonarpost import keys, wire
from sonarpost.cli.detection.options import read_transmissions
from sonarpost.delivery.store import Store
from sonarpost.errors import DeliveryError
from sonarpost.messages import Transmission, Transmissions
from sonarpost.modem.interface import TransmissionEnded, TransmissionStarted
from sonarpost.services.atd_stub.transmissions import MAX_RETAINED, RETAINED_S, SAVE_INTERVAL_S, TransmissionLog
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService

KEY = keys.acoustic_transmissions("uuv-1")


def record_of(*pairs):
    rows = tuple(Transmission(start_utc_s=start_s, end_utc_s=end_s) for start_s, end_s in pairs)
    return Transmissions(platform_id="uuv-1", time_utc_s=time.time(), transmissions=rows)


# Log


@pytest.fixture
def store(tmp_path):
    store = Store(tmp_path / "atd_stub.db")
    yield store
    store.close()


class Bench:
    """A log on a store, with the number of its commits."""

    def __init__(self, store, file=None) -> None:
        self.commits = 0
        self.fails = False
        self._store = store
        self.log = TransmissionLog(store, self._commit, lambda error: None, file)

    def _commit(self, effects) -> None:
        if self.fails:
            raise DeliveryError("disk is full")
        self.commits += 1
        with self._store.transaction() as tx:
            effects.write(tx)

    @property
    def times(self):
        found = self.log.intervals(0.0, 0.0)
        return list(zip(found.starts_utc_s, found.ends_utc_s, strict=True))


def test_a_later_record_replaces_the_nominal_end(store):
    bench, now_s = Bench(store), time.time()
    bench.log.add(record_of((now_s - 50.0, now_s - 44.0)), now_s)
    bench.log.add(record_of((now_s - 50.0, now_s - 45.0), (now_s - 10.0, now_s - 4.0)), now_s)
    assert bench.times == [(now_s - 50.0, now_s - 45.0), (now_s - 10.0, now_s - 4.0)]


def test_transmissions_are_restored_from_the_store(store):
    bench, now_s = Bench(store), time.time()
    pairs = [(now_s - age_s, now_s - age_s + 5.0) for age_s in (80_000.0, 7000.0, 20.0)]
    bench.log.add(record_of(*pairs), now_s)
    bench.log.save()
    assert Bench(store).times == pairs


def test_only_changes_are_written_and_at_most_once_a_minute(store):
    bench, now_s = Bench(store), time.time()
    bench.log.save(0.0)
    assert bench.commits == 0
    bench.log.add(record_of((now_s - 50.0, now_s - 45.0)), now_s)
    bench.log.save(SAVE_INTERVAL_S - 1.0)
    assert bench.commits == 0
    bench.log.save(SAVE_INTERVAL_S)
    bench.log.save(2 * SAVE_INTERVAL_S)
    assert bench.commits == 1


def test_a_write_that_fails_is_repeated(store, tmp_path):
    bench, now_s = Bench(store, tmp_path / "transmissions.json"), time.time()
    bench.log.add(record_of((now_s - 50.0, now_s - 45.0)), now_s)
    bench.fails = True
    with pytest.raises(DeliveryError):
        bench.log.save(0.0)
    bench.log.save_at_stop()
    bench.fails = False
    bench.log.save(1.0)
    assert Bench(store).times == [(now_s - 50.0, now_s - 45.0)]
    assert read_transmissions(tmp_path / "transmissions.json") == ((now_s - 50.0, now_s - 45.0),), "for the command"


def test_retention(store):
    bench, now_s = Bench(store), time.time()
    pairs = [(now_s - offset_s, now_s - offset_s + 1.0) for offset_s in (RETAINED_S + 5.0, 10.0, -RETAINED_S - 5.0)]
    bench.log.add(record_of(*pairs), now_s)
    assert bench.times == [pairs[1]]
    for first in range(0, MAX_RETAINED + 500, 500):
        starts = (now_s - 40_000.0 + 1.5 * number for number in range(first, first + 500))
        bench.log.add(record_of(*((start_s, start_s + 1.0) for start_s in starts)), now_s)
    assert len(bench.log) == MAX_RETAINED
    bench.log.save()
    bench.log.add(record_of(), now_s + 2 * RETAINED_S)
    bench.log.save()
    assert not store.states("transmissions:")


def test_damaged_transmissions_are_quarantined(store):
    damaged = [b"\xc1", b"\x01", msgpack.packb([[1.0]]), msgpack.packb([[2.0, 1.0]])]
    with store.transaction() as tx:
        for number, packed in enumerate(damaged):
            tx.put_state(f"transmissions:{number}", packed)
    assert Bench(store).times == []
    assert (store.states_discarded, store.refused_count()) == (len(damaged), len(damaged))


# Service


NOISE = (60, 72)
"""First and one-past-last ping of the modem's noise in `put_survey`."""


@pytest.fixture
def put_survey(tmp_path, incoming):
    """Deliver a survey with an object at ping 160 and the modem's noise."""

    def put(name, started_s):
        survey = survey_of(240, Box(160), Box(66))
        offset_s = started_s - survey.pings[0].time_utc_s
        pings = tuple(replace(ping, time_utc_s=ping.time_utc_s + offset_s) for ping in survey.pings)
        write_xtf(replace(survey, pings=pings), tmp_path / name)
        (tmp_path / name).rename(incoming / name)

    return put


def known(service):
    return service.health().gauges["transmissions_known"]


def noise_times(started_s):
    pings = survey_of(240).pings
    first_s = pings[0].time_utc_s
    return started_s + pings[NOISE[0]].time_utc_s - first_s, started_s + pings[NOISE[1]].time_utc_s - first_s


def test_noise_of_the_modem_is_a_contact_without_masking(start_service, compressor, put_survey, counter):
    service = start_service(mask_transmissions=False)
    put_survey("line.xtf", time.time() - 300.0)
    eventually(lambda: counter(service, "files_processed") == 1)
    eventually(lambda: len(compressor.received) == 2)
    assert counter(service, "pings_masked") == 0


def test_published_transmissions_are_masked_also_after_a_restart(
    start_service, runner, compressor, put_survey, publish, counter
):
    started_s = float(round(time.time() - 300.0))
    service = start_service()
    publish(KEY, wire.encode(record_of(noise_times(started_s))))
    eventually(lambda: known(service) == 1)
    runner.stop(service)
    service = start_service()
    assert known(service) == 1
    put_survey("line.xtf", started_s)
    eventually(lambda: counter(service, "files_processed") == 1)
    eventually(lambda: len(compressor.received) >= 1)
    assert len(near(compressor.received, 160)) == len(compressor.received) == 1
    assert NOISE[1] - NOISE[0] <= counter(service, "pings_masked") <= 40


def test_a_mostly_masked_file_is_one_warning(start_service, put_survey, publish, caplog, counter):
    started_s = float(round(time.time() - 300.0))
    service = start_service()
    publish(KEY, wire.encode(record_of((started_s, started_s + 200.0))))
    eventually(lambda: known(service) == 1)
    put_survey("line.xtf", started_s)
    eventually(lambda: counter(service, "files_processed") == 1)
    eventually(lambda: "Most pings masked" in caplog.text)
    (warning,) = [r for r in caplog.records if r.message.startswith("Most pings masked")]
    assert warning.levelno == logging.WARNING
    assert counter(service, "pings_masked") == 240


def test_malformed_and_hostile_records_are_logged_counted_and_ignored(start_service, publish, caplog, counter):
    service = start_service()
    everything = {"transmissions": ({"start_utc_s": 0.0, "end_utc_s": 2.5e11},)}
    hostile = msgpack.packb(wire.unpack_map(wire.encode(record_of()), KEY) | everything)
    for payload in (b"\xc1", msgpack.packb({"type": "transmissions", "v": 1}), hostile):
        publish(KEY, payload)
    now_s = time.time()
    publish(KEY, wire.encode(record_of((now_s - 20.0, now_s - 15.0))))
    eventually(lambda: known(service) == 1)
    assert counter(service, "transmissions_ignored") == 3
    assert "Ignoring malformed transmissions" in caplog.text
    assert not service.failed


def test_a_late_subscriber_receives_the_transmissions_of_uuv_modem(start_service, runner, platform, modem_pair):
    config = UuvModemConfig(port=modem_pair.port(modem_pair.VEHICLE))
    modem = runner.start(UuvModemService(platform("uuv-1"), config))
    modem.on_modem_event(TransmissionStarted(6.1))
    modem.on_modem_event(TransmissionEnded(6.1))
    service = start_service()
    assert known(service) == 1
    modem.on_modem_event(TransmissionStarted(6.1))
    eventually(lambda: known(service) == 2, what="the transmission in progress")
