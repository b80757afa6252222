import itertools

import pytest
from builders.fake_modem import FakeModem, drop_nth

from sonarpost.errors import ConfigError
from sonarpost.modem.interface import (
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketSent,
    SentenceRejected,
    SettingUnconfirmed,
)
from sonarpost.modem.micromodem import FailureReason, MicroModem, MicroModemConfig
from sonarpost.modem.micromodem.supervisor import Phase

CONFIG = MicroModemConfig(address=3)
SETTINGS = {"SRC": "3", "CST": "1", "RXP": "1", "TXP": "1", "TXF": "1", "XST": "1"}


def started(config: MicroModemConfig = CONFIG, **options) -> FakeModem:
    modem = FakeModem(MicroModem(config), **options)
    modem.driver.port_opened(0.0)
    return modem


def test_first_bytes_of_the_configuration() -> None:
    driver = MicroModem(MicroModemConfig(address=1))
    assert driver.next_wakeup() is None
    driver.port_opened(10.0)
    assert driver.bytes_to_send() == b"$CCCFG,SRC,1*31\r\n"
    assert driver.next_wakeup() == 15.0
    driver.receive(b"$CACFG,SRC,1*33\r\n", 10.1)
    assert driver.bytes_to_send() == b"$CCCFG,CST,1*37\r\n"
    assert not driver.ready


def test_configuration_sets_and_verifies_address_and_statistics() -> None:
    modem = started()
    modem.run(5.0)
    assert modem.events == [ModemReady(address=3, firmware=None)]
    assert modem.settings == SETTINGS
    assert modem.commands("CCCFQ") == [("SRC",), ("CST",)]
    assert modem.driver.ready


def test_unconfirmed_optional_setting_does_not_block_the_start() -> None:
    config = MicroModemConfig(address=3, settings=(("RXP", 1), ("gain.x", 7)))
    modem = started(config, drops=lambda sentence, _: sentence.fields[:1] == ("gain.x",))
    modem.run(30.0)
    assert modem.events == [SettingUnconfirmed("CCCFG,gain.x,7"), ModemReady(3, None)]


def test_wrong_echo_is_not_accepted_and_one_with_leading_zeros_and_more_fields_is() -> None:
    driver = MicroModem(CONFIG)
    driver.port_opened(0.0)
    driver.bytes_to_send()
    for wrong in (b"$CACFG,SRC,4\r\n", b"$CACFG,CST,3\r\n", b"$CACFG,SRC\r\n", b"$CACLK,2016,1,1,0,0,0\r\n"):
        driver.receive(wrong, 0.1)
        assert driver.bytes_to_send() == b""
    driver.receive(b"$CACFG,SRC,003,extra\r\n", 0.2)
    assert driver.bytes_to_send() == b"$CCCFG,CST,1*37\r\n"


def test_configuration_during_a_dump_with_revisions() -> None:
    """A dump of 200 settings, with the old value of the address among them, starts before the echo."""
    modem = started(drops=drop_nth("CACFG", 1))
    for number in range(200):
        modem.schedule(0.02 + number * 0.05, lambda n=number: modem.send("CACFG", f"X{n}", n))
    modem.schedule(0.5, lambda: modem.send("CACFG", "SRC", 0))
    modem.schedule(1.0, lambda: modem.send("CAREV", "181807", "AUV", "2.0.27087"))
    modem.drops = lambda sentence, _: sentence.fields == ("SRC", "3") and modem.now < 9.0
    modem.run(25.0)
    assert modem.events == [ModemReady(3, "2.0.27087")]
    assert len([c for c in modem.commands("CCCFG") if c[0] == "SRC"]) <= 2, "more queries would prolong the dump"


def test_wait_during_an_endless_dump_is_bounded() -> None:
    modem = started(drops=lambda sentence, _: sentence.kind == "CCCFG")

    def dump() -> None:
        modem.send("CACFG", "X", 1)
        modem.schedule(0.5, dump)

    modem.schedule(0.5, dump)
    modem.run(CONFIG.dump_limit_s + 1.0)
    assert len(modem.received) == 0
    assert modem.sentence_counts["CCCFG"] == 2


def test_silent_modem_is_reported_once_and_retried() -> None:
    modem = started()
    modem.unresponsive = True
    modem.run(3600.0)
    assert modem.events == [ModemUnresponsive("CCCFG,SRC,3", attempts=3, silent_s=None)]
    tries = modem.sentence_counts["CCCFG"]
    assert 3600 / CONFIG.retry_cap_s - 2 < tries < 3600 / CONFIG.retry_cap_s + 10, "waits grow up to the limit"
    modem.unresponsive = False
    modem.run(3600.0 + 2 * CONFIG.retry_cap_s)
    assert modem.events[1:] == [ModemReady(3, None)]


def test_retry_waits_double_up_to_the_limit() -> None:
    driver = MicroModem(MicroModemConfig(address=3, reply_timeout_s=1.0, retry_cap_s=10.0))
    driver.port_opened(0.0)
    sent_s, now = [], 0.0
    while len(sent_s) < 8:
        if data := driver.bytes_to_send():
            assert data == b"$CCCFG,SRC,3*33\r\n"
            sent_s.append(now)
        now = driver.next_wakeup()
        driver.poll(now)
    gaps = [b - a for a, b in itertools.pairwise(sent_s)]
    assert gaps == [1.0, 2.0, 4.0, 8.0, 10.0, 10.0, 10.0]


def test_every_failure_of_an_idle_modem_is_reported_once_and_the_modem_reconfigured() -> None:
    modem = started()
    for _ in range(2):
        modem.run(modem.now + 10.0)
        modem.events.clear()
        modem.unresponsive = True
        modem.settings["SRC"] = "0"
        modem.run(modem.now + 200.0)
        [unresponsive] = modem.events
        assert isinstance(unresponsive, ModemUnresponsive)
        assert unresponsive.waiting_for == "CCCFQ,SRC"
        assert unresponsive.silent_s > CONFIG.keepalive_s
        assert not modem.driver.ready
        modem.unresponsive = False
        modem.run(modem.now + 150.0)
        assert modem.events[1:] == [ModemReady(3, None)]
        assert modem.settings["SRC"] == "3"


def test_idle_modem_is_queried_only_when_silent() -> None:
    modem = started()
    modem.run(5.0)
    for second in range(600):
        modem.schedule(float(second), lambda: modem.send("CAREV", "000000", "AUV", "0.93.0.09"))
    before = len(modem.received)
    modem.run(600.0)
    assert len(modem.received) == before
    modem.run(700.0)
    assert modem.commands("CCCFQ")[2:] == [("SRC",)] * 3
    assert modem.events == [ModemReady(3, None)]


def test_changed_address_is_corrected() -> None:
    modem = started()
    modem.run(5.0)
    modem.settings["SRC"] = "9"
    modem.run(60.0)
    assert modem.settings["SRC"] == "3"
    assert modem.events == [ModemReady(3, None)] * 2


def test_restarted_modem_is_reconfigured() -> None:
    modem = started()
    modem.run(5.0)
    modem.settings = {}
    modem.send("CAREV", "000001", "INIT", "0.93.0.09")
    assert not modem.driver.ready
    sent = len(modem.received)
    modem.run(5.0 + 0.9 * CONFIG.init_pause_s)
    assert len(modem.received) == sent, "nothing is sent during the pause after a restart"
    modem.run(20.0)
    assert modem.events[1:] == [ModemRebooted("0.93.0.09"), ModemReady(3, "0.93.0.09")]
    assert modem.settings == SETTINGS


def test_packet_fails_when_the_modem_is_not_ready_in_time() -> None:
    modem = started()
    modem.unresponsive = True
    packet_id = modem.driver.send_packet(1, 4, [b"x"], now=0.0)
    modem.run(CONFIG.max_defer_s + 1.0)
    (failed,) = modem.events_of(PacketFailed)
    assert (failed.packet_id, failed.reason) == (packet_id, FailureReason.DEFERRED_TOO_LONG)
    assert not failed.maybe_sent
    modem.driver.send_packet(1, 4, [b"y"], now=modem.now)
    modem.unresponsive = False
    modem.run(modem.now + 100.0)
    assert [event.frames for event in modem.events_of(PacketSent)] == [(b"y",)]


def test_invalid_sentences_are_reported_and_unknown_ones_ignored() -> None:
    modem = started()
    modem.run(5.0)
    modem.send("CATOA", "120000.1234", 1)
    modem.send("CACFG", "BW", 2)
    modem.send_bytes(b"$CATXF,28*00\r\nnoise\r\n")
    modem.send("CAREV", "000000")
    assert [type(event) for event in modem.events] == [ModemReady, *[SentenceRejected] * 3]
    assert [event.error.field for event in modem.events_of(SentenceRejected)] == ["checksum", "", "fields"]


def test_closed_port_has_no_activity() -> None:
    driver = MicroModem(CONFIG)
    assert driver.receive(b"$CAREV,000001,INIT,1\r\n", 0.0) == []
    assert driver.poll(100.0) == []
    driver.port_opened(100.0)
    driver.port_lost(101.0)
    assert driver.bytes_to_send() == b""
    assert driver.next_wakeup() is None
    assert driver.phase is Phase.CLOSED


def test_unfinished_line_is_dropped_when_the_port_reopens() -> None:
    driver = MicroModem(CONFIG)
    driver.port_opened(0.0)
    driver.receive(b"$CACFG,SRC", 0.1)
    driver.port_lost(1.0)
    driver.port_opened(2.0)
    driver.bytes_to_send()
    assert driver.receive(b"$CACFG,SRC,3\r\n", 2.1) == []
    assert driver.bytes_to_send() == b"$CCCFG,CST,1*37\r\n"


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("address", -1),
        ("address", 128),
        ("tries", 0),
        ("queued_packets", 0),
        ("airtime_margin", 0.5),
        ("reply_timeout_s", 0.0),
        ("max_defer_s", float("inf")),
        ("keepalive_s", float("nan")),
        ("airtimes_s", {9: 1.0}),
        ("airtimes_s", {1: 0.0}),
    ],
)
def test_configuration_error_names_the_field(field: str, wrong: object) -> None:
    with pytest.raises(ConfigError) as caught:
        MicroModemConfig(**{"address": 1, field: wrong})
    assert caught.value.field.startswith(field)


def test_air_times_of_the_configuration() -> None:
    config = MicroModemConfig(address=1, airtimes_s={1: 3.1})
    assert [config.airtime_s(rate) for rate in (1, 5, None, 77)] == [3.1, 3.1, 3.4, 3.4]
