"""Modems that hide transmissions, report a busy channel for ever, reject commands, or answer late."""

import itertools

import pytest
from builders.fake_modem import DropRule, FakeModem, drop_nothing

from sonarpost.modem.interface import (
    CarrierSenseIgnored,
    CarrierSenseRestored,
    ModemReady,
    ModemRebooted,
    PacketFailed,
    PacketSent,
    RequestFailed,
    RestartRequested,
    SettingUnconfirmed,
    TransmissionFailing,
    TransmissionRecovered,
)
from sonarpost.modem.micromodem import FailureReason, MicroModem, MicroModemConfig

CONFIG = MicroModemConfig(address=3)
MARKS = {"TXP": "CATXP", "TXF": "CATXF", "XST": "CAXST"}
HOUR_S = 3600.0


def ready(config: MicroModemConfig = CONFIG, drops: DropRule = drop_nothing) -> FakeModem:
    modem = FakeModem(MicroModem(config), drops)
    modem.driver.port_opened(0.0)
    modem.run(5.0)
    assert isinstance(modem.events[-1], ModemReady)
    modem.events.clear()
    modem.received.clear()
    return modem


class Sender:
    """Keeps one packet queued, like a service with a backlog: a failed packet is queued again after `retry_s`."""

    retry_s = 2.0

    def __init__(self, modem: FakeModem, packets: int = 2000) -> None:
        self.modem = modem
        self.waiting = [bytes([n % 256, n // 256, 0]) for n in range(packets)]
        self.attempts = 0
        self._packet_id: int | None = None
        self._seen = 0
        self._offer()

    def run(self, until_s: float) -> None:
        while self.modem.now < until_s:
            self.modem.run(min(until_s, self.modem.now + 2.0))
            self._offer()

    def _offer(self) -> None:
        results = [e for e in self.modem.events[self._seen :] if isinstance(e, (PacketSent, PacketFailed))]
        self._seen = len(self.modem.events)
        for result in results:
            assert result.packet_id == self._packet_id
            self._packet_id = None
            if isinstance(result, PacketSent):
                self.waiting.pop(0)
            else:
                self._retry_at_s = self.modem.now + self.retry_s
        if self._packet_id is None and self.waiting and self.modem.now >= getattr(self, "_retry_at_s", 0.0):
            self.attempts += 1
            self._packet_id = self.modem.driver.send_packet(1, 4, [self.waiting[0]], now=self.modem.now)


# Transmissions that the modem does not report


@pytest.mark.parametrize(
    "fixed", [{"TXF", "XST"}, {"TXP", "TXF", "XST"}, {"TXF"}, {"TXP", "TXF"}], ids=lambda fixed: "-".join(sorted(fixed))
)
@pytest.mark.parametrize("echoes", [True, False])
def test_packet_is_sent_once_by_a_modem_that_does_not_report_transmissions(fixed: set[str], echoes: bool) -> None:
    modem = FakeModem(MicroModem(CONFIG))
    modem.fixed_settings = fixed
    if not echoes:
        modem.drops = lambda sentence, _: sentence.kind == "CACFG" and sentence.fields[0] in fixed
    modem.driver.port_opened(0.0)
    modem.run(60.0)
    sender = Sender(modem, 3)
    sender.run(600.0)
    assert modem.events_of(PacketFailed) == []
    assert [event.frames for event in modem.events_of(PacketSent)] == modem.transmitted
    assert len(modem.transmitted) == len(set(modem.transmitted)) == 3
    assert {event.end_reported for event in modem.events_of(PacketSent)} == {"XST" not in fixed}


def test_time_of_a_packet_whose_transmission_is_not_reported_is_limited() -> None:
    modem = ready(drops=lambda sentence, _: sentence.kind in MARKS.values())
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.run(60.0)
    (sent,) = modem.events_of(PacketSent)
    assert sent.finished_s - sent.started_s < CONFIG.start_timeout_s + CONFIG.on_air_limit_s(4) + 1.0


@pytest.mark.parametrize(
    ("lost", "reason"),
    [
        ({"CATXP", "CATXF", "CAXST"}, FailureReason.NO_TRANSMIT_START),
        ({"CATXF", "CAXST"}, FailureReason.NO_TRANSMIT_END),
    ],
)
def test_unreported_transmission_fails_if_the_modem_does_not_answer_afterwards(lost, reason: FailureReason) -> None:
    modem = ready()
    modem.drops = lambda sentence, _: sentence.kind in {*lost, "CACFG"}
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.run(40.0)
    (failed,) = modem.events_of(PacketFailed)
    assert (failed.reason, failed.maybe_sent) == (reason, True)


def test_packet_fails_if_the_modem_reports_an_error_and_no_transmission() -> None:
    modem = ready(drops=lambda sentence, _: sentence.kind in MARKS.values())
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.schedule(0.5, lambda: modem.send("CAERR", "000000", "AMP", 1, "battery low"))
    modem.run(30.0)
    (failed,) = modem.events_of(PacketFailed)
    assert (failed.reason, failed.maybe_sent) == (FailureReason.NO_TRANSMIT_START, True)


def test_late_end_of_a_transmission_is_accepted_after_the_query() -> None:
    modem = ready(drops=lambda sentence, _: sentence.kind in {"CATXF", "CAXST"})
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.run(5.0 + 0.3 + CONFIG.on_air_limit_s(4) - 0.2)
    modem.drops = lambda sentence, _: sentence.kind == "CACFG"
    modem.schedule(0.4, lambda: modem.send("CATXF", 1))
    modem.run(modem.now + CONFIG.statistics_timeout_s + 1.0)
    assert len(modem.commands("CCCFQ")) == 1
    (sent,) = modem.events_of(PacketSent)
    assert sent.end_reported


# A channel that is reported as busy for ever


@pytest.mark.parametrize("interval_s", [1.0, 12.0])
@pytest.mark.parametrize(("kind", "end_s"), [("CARXP", None), ("CARXP", 2.0), ("CATXP", None)])
def test_packets_are_sent_in_spite_of_false_reports(interval_s: float, kind: str, end_s: float | None) -> None:
    """A false CARXP again and again, followed by PACKET_TIMEOUT or by nothing; or a false CATXP without an end."""
    modem = ready()

    def phantom() -> None:
        if kind == "CARXP" or modem.driver.queued:
            modem.send(kind, 1)
        if end_s:
            modem.schedule(min(end_s, interval_s / 2), lambda: modem.send("CAMSG", "PACKET_TIMEOUT", 1))
        modem.schedule(interval_s, phantom)

    phantom()
    sender = Sender(modem)
    sender.run(HOUR_S / 6)
    if kind == "CARXP":
        assert modem.events_of(PacketFailed) == []
        assert len(modem.events_of(CarrierSenseIgnored)) == (0 if end_s else 1)
    assert len(modem.transmitted) > (50 if kind == "CARXP" else 8)


def test_first_packet_waits_no_longer_than_the_limit_of_carrier_sense() -> None:
    modem = ready()
    started_s = modem.now
    modem.send("CARXP", 1)
    for n in range(1, 100):
        modem.schedule(n * 10.0, lambda: modem.send("CARXP", 1))
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.run(started_s + CONFIG.max_carrier_sense_s - 0.1)
    assert modem.received == []
    modem.run(started_s + CONFIG.max_carrier_sense_s + 0.1)
    assert [sentence.kind for sentence in modem.received] == ["CCCYC", "CCTXD"]
    assert modem.events_of(CarrierSenseIgnored) == [CarrierSenseIgnored(CONFIG.max_carrier_sense_s)]


def test_carrier_sense_is_restored_when_the_channel_becomes_free() -> None:
    modem = ready()
    for n in range(5):
        modem.schedule(n * 10.0, lambda: modem.send("CARXP", 1))
    modem.run(100.0)
    (restored,) = modem.events_of(CarrierSenseRestored)
    assert restored.busy_s == pytest.approx(40.0 + CONFIG.on_air_limit_s(None), abs=0.2)
    modem.received.clear()
    modem.send("CARXP", 1)
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.run(105.0)
    assert modem.received == [], "the driver defers again"


def test_genuine_receptions_are_not_disturbed() -> None:
    """A reception with its announcement, frames and statistics: the driver sends nothing before its end."""
    modem = ready()
    for start_s in range(0, 600, 10):
        at_s = float(start_s)
        modem.schedule(at_s, lambda: modem.send("CARXP", 1))
        modem.schedule(at_s + 0.5, lambda: modem.send("CACYC", 0, 1, 3, 1, 0, 3))
        modem.schedule(at_s + 6.0, lambda: modem.send("CARXD", 1, 3, 0, 1, "61"))
        modem.schedule(at_s + 6.1, lambda: modem.send("CACST", 6, 0))
    starts: list[float] = []
    sender = Sender(modem)
    while modem.now < 600.0:
        before = len(modem.commands("CCCYC"))
        sender.run(modem.now + 0.25)
        starts += [(modem.now - 5.0) % 10.0] * (len(modem.commands("CCCYC")) - before)
    assert len(starts) > 50
    assert all(start_s == 0.0 or start_s >= 6.0 for start_s in starts[1:]), starts


# A modem that rejects every command of a cycle


def test_command_rejected_once_is_sent_again_soon() -> None:
    modem = ready()
    modem.refuses_cycles = True
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.schedule(0.5, lambda: setattr(modem, "refuses_cycles", False))
    modem.run(20.0)
    assert len(modem.commands("CCCYC")) == 2
    (sent,) = modem.events_of(PacketSent)
    assert sent.finished_s - sent.started_s < 7.0


def test_packet_that_is_always_rejected_fails_with_its_reason() -> None:
    modem = ready()
    modem.refuses_cycles = True
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.run(5.0 + CONFIG.tries * (CONFIG.refused_wait_s + 0.1))
    assert len(modem.commands("CCCYC")) == CONFIG.tries
    (failed,) = modem.events_of(PacketFailed)
    assert (failed.reason, failed.maybe_sent) == (FailureReason.REFUSED, False)


def test_error_report_does_not_repeat_a_command_that_is_echoed() -> None:
    modem = ready()
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.schedule(0.01, lambda: modem.send("CAERR", "000000", "NMEA", 2, "of another host"))
    modem.run(20.0)
    assert len(modem.commands("CCCYC")) == 1
    assert len(modem.events_of(PacketSent)) == 1


@pytest.mark.parametrize("silent", [(), ("CAREV",)], ids=["reported", "not reported"])
def test_modem_that_rejects_every_packet_is_reported_and_restarted(silent: tuple[str, ...]) -> None:
    modem = ready()
    modem.refuses_cycles = True
    modem.silent_kinds.update(silent)
    sender = Sender(modem, 3)
    sender.run(5.0 + 20.0)
    assert modem.events_of(TransmissionFailing) == [TransmissionFailing(3, FailureReason.REFUSED)]
    assert modem.commands("CCMSC") == [("3", "3", "0")]
    assert len(modem.events_of(RestartRequested, ModemRebooted)) == (1 if silent else 2)
    assert silent or len(modem.events_of(ModemReady)) == 1, "the modem is configured again"
    modem.refuses_cycles = False
    sender.run(60.0)
    assert modem.transmitted == [(b"\x00\x00\x00",), (b"\x01\x00\x00",), (b"\x02\x00\x00",)]
    (recovered,) = modem.events_of(TransmissionRecovered)
    assert recovered.failures >= 3
    assert 10.0 < recovered.failing_s < 40.0


def test_restarts_of_a_modem_that_never_transmits_become_rare() -> None:
    modem = ready(MicroModemConfig(address=3, restart_backoff_cap_s=300.0))
    modem.refuses_cycles = True
    sender = Sender(modem)
    restarts_s: list[float] = []
    while modem.now < HOUR_S / 2:
        sender.run(modem.now + 2.0)
        restarts_s += [modem.now] * (modem.restarts - len(restarts_s))
    waits_s = [b - a for a, b in itertools.pairwise(restarts_s)]
    assert len(waits_s) >= 5
    for wait_s, backoff_s in zip(waits_s, [60, 120, 240, *[300] * 10], strict=False):
        assert backoff_s - 5.0 <= wait_s < backoff_s + 15.0
    assert len(modem.events_of(TransmissionFailing)) == 1
    modem.refuses_cycles = False
    sender.run(modem.now + 60.0)
    assert modem.transmitted


def test_backoff_of_restarts_is_short_again_after_the_modem_has_worked() -> None:
    modem = ready()
    sender = Sender(modem)
    for _ in range(3):
        modem.refuses_cycles = True
        before = modem.restarts
        sender.run(modem.now + 25.0)
        assert modem.restarts == before + 1
        modem.refuses_cycles = False
        sender.run(modem.now + 10 * CONFIG.restart_backoff_s)


def test_rejected_requests_that_the_modem_may_not_support_do_not_restart_it() -> None:
    modem = ready()
    for _ in range(5):
        modem._on_ccmpc = lambda *_: modem.send("CAERR", "000000", "NMEA", 2, "unknown")  # type: ignore[attr-defined]
        modem.driver.ping(1, modem.now)
        modem.run(modem.now + 30.0)
    assert [event.reason for event in modem.events_of(RequestFailed)] == [FailureReason.REFUSED] * 5
    assert modem.restarts == 0


def test_rejected_polls_restart_the_modem() -> None:
    modem = ready()
    modem.refuses_cycles = True
    for _ in range(3):
        modem.driver.request_packet(1, 1, now=modem.now)
        modem.run(modem.now + 4.0)
    assert len(modem.commands("CCCYC")) == 3 * CONFIG.tries
    assert [event.reason for event in modem.events_of(RequestFailed)] == [FailureReason.REFUSED] * 3
    assert modem.restarts == 1


# Configuration dumps and late answers


def dump(modem: FakeModem, lines: int, interval_s: float = 0.06) -> None:
    """The modem sends the lines of a dump, and answers commands after it."""
    ends_s = modem.now + lines * interval_s
    delayed = modem._schedule_reply

    def reply(delay_s: float, action) -> None:
        delayed(max(delay_s, ends_s - modem.now + delay_s), action)

    modem._schedule_reply = reply  # type: ignore[method-assign]
    for n in range(lines):
        modem.schedule(n * interval_s, lambda n=n: modem.send("CACFG", f"X{n}", n))


def test_no_packet_is_started_during_a_dump() -> None:
    modem = ready()
    dump(modem, 600)
    modem.schedule(1.0, lambda: modem.driver.send_packet(1, 4, [b"x"], now=modem.now))
    modem.run(5.0 + 36.0 + CONFIG.dump_quiet_s - 0.1)
    assert modem.received == []
    modem.run(modem.now + 10.0)
    assert len(modem.commands("CCCYC")) == 1
    assert modem.transmitted == [((b"x"),)]


@pytest.mark.parametrize("delay_s", [0.01, 0.07, 0.12, 0.17])
def test_commands_are_not_repeated_when_a_dump_delays_their_answers(delay_s: float) -> None:
    modem = ready()
    modem.data_timeout_s = 100.0
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.schedule(delay_s, lambda: dump(modem, 600))
    modem.run(100.0)
    assert len(modem.commands("CCCYC")) == 1
    assert [data for *_, data in modem.commands("CCTXD")] == ["78"]
    assert len(modem.events_of(PacketSent)) == 1
    assert modem.transmitted == [((b"x"),)]


def test_endless_dump_delays_a_packet_by_a_limited_time() -> None:
    modem = ready()
    for n in range(3000):
        modem.schedule(n * 0.5, lambda n=n: modem.send("CACFG", "X", n))
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.schedule(0.1, lambda: modem.driver.send_packet(1, 4, [b"y"], now=modem.now))
    modem.run(5.0 + CONFIG.dump_limit_s + 10.0)
    assert modem.transmitted == [(b"x",), (b"y",)]


def test_modem_that_was_silent_is_used_soon_after_its_next_sentence() -> None:
    modem = ready()
    modem.unresponsive = True
    modem.run(1800.0)

    def revision() -> None:
        modem.send("CAREV", "000000", "AUV", "2.0.27087")
        modem.schedule(10.0, revision)

    modem.unresponsive = False
    modem.schedule(1.0, revision)
    modem.driver.send_packet(1, 4, [b"x"], now=modem.now)
    modem.run(1802.0)
    assert modem.driver.ready
    modem.run(1810.0)
    assert modem.transmitted == [(b"x",)]


def test_sentences_of_a_modem_that_does_not_answer_cause_no_burst_of_commands() -> None:
    modem = ready()
    modem.silent_kinds.add("CACFG")
    for n in range(1500):
        modem.schedule(n * 0.2, lambda: modem.send("CATOA", "120000.1234", 1))
    modem.send("CACFG", "SRC", 9)
    modem.driver.port_opened(modem.now)
    modem.received.clear()
    modem.run(305.0)
    assert len(modem.received) <= 300.0 / CONFIG.reply_timeout_s + 1


def test_rejected_optional_settings_do_not_delay_the_start() -> None:
    modem = FakeModem(MicroModem(CONFIG))
    refused = {"RXP", "TXP", "TXF", "XST"}
    accept = modem._on_cccfg

    def configure(name: str, value: str) -> None:
        if name in refused:
            modem._schedule_reply(0.05, lambda: modem.send("CAERR", "000000", "NMEA", 2, "unknown setting"))
        else:
            accept(name, value)

    modem._on_cccfg = configure  # type: ignore[method-assign]
    modem.driver.port_opened(0.0)
    modem.run(10.0)
    assert len(modem.events_of(SettingUnconfirmed)) == 4
    assert modem.driver.ready
