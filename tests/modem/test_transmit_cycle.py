import pytest
from builders.fake_modem import DropRule, FakeModem, drop_nothing, drop_nth
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.modem.interface import (
    ModemError,
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketSent,
    SentenceRejected,
    TransmissionEnded,
    TransmissionStarted,
)
from sonarpost.modem.micromodem import (
    RATES,
    FailureReason,
    MicroModem,
    MicroModemConfig,
    nmea,
)

CONFIG = MicroModemConfig(address=3)
FIRST = [b"a" * 256, b"b"]
SECOND = [b"c" * 256, b"d"]


def ready(drops: DropRule = drop_nothing, config: MicroModemConfig = CONFIG) -> FakeModem:
    modem = FakeModem(MicroModem(config), drops)
    modem.driver.port_opened(0.0)
    modem.run(5.0)
    assert modem.events == [ModemReady(3, None)]
    modem.events.clear()
    modem.received.clear()
    return modem


def send(modem: FakeModem, frames: list[bytes], rate: int = 4, **options) -> int:
    return modem.driver.send_packet(1, rate, frames, now=modem.now, **options)


def test_bytes_of_a_complete_cycle() -> None:
    driver = MicroModem(MicroModemConfig(address=2, settings=()))
    driver.port_opened(0.0)
    for answer in (b"$CACFG,SRC,2\r\n", b"$CACFG,CST,1\r\n") * 2:
        driver.bytes_to_send()
        driver.receive(answer, 0.0)
    packet_id = driver.send_packet(1, 0, [b"\x00\xffA"], ack=True, now=1.0)
    assert driver.bytes_to_send() == b"$CCCYC,0,2,1,0,1,1*5A\r\n"
    assert driver.receive(b"$CACYC,0,2,1,0,1,1\r\n", 1.1) == []
    assert driver.receive(b"$CADRQ,000001,2,1,1,32,1\r\n", 1.2) == []
    assert driver.bytes_to_send() == b"$CCTXD,2,1,1,00FF41*7F\r\n"
    assert driver.receive(b"$CATXD,2,1,1,3\r\n", 2.0) == []
    assert driver.receive(b"$CATXP,3\r\n", 2.0) == [TransmissionStarted(RATES[0].airtime_s)]
    assert driver.receive(b"$CATXF,3\r\n", 2.0) == [TransmissionEnded(RATES[0].airtime_s)]
    assert driver.receive(b"$CAXST,7,20250606,230117.336548,3,0,200,5000,25000,0,2,1,1,1,1,1,3\r\n", 5.0) == []
    *_, sent = driver.receive(b"$CAACK,1,2,1,1\r\n", 9.0)
    assert isinstance(sent, PacketSent)
    assert (sent.packet_id, sent.dest, sent.rate, sent.frames) == (packet_id, 1, 0, (b"\x00\xffA",))
    assert (sent.acknowledged, sent.started_s, sent.finished_s) == ((1,), 1.0, 9.0)


def test_empty_frame_is_sent_as_empty_hex() -> None:
    modem = ready()
    send(modem, [b"x", b""])
    modem.run(20.0)
    assert modem.commands("CCTXD") == [("3", "1", "0", "78"), ("3", "1", "0", "")]
    assert len(modem.events_of(PacketSent)) == 1


@pytest.mark.parametrize(
    ("destination", "rate", "frames", "field"),
    [
        (1, 4, [b"x" * 257], "length of frame 1"),
        (1, 1, [b"x" * 64, b"x" * 65], "length of frame 2"),
        (1, 0, [b"x", b"x"], "frames"),
        (1, 4, [], "frames"),
        (1, 7, [b"x"], "rate"),
        (128, 4, [b"x"], "destination"),
        (-1, 4, [b"x"], "destination"),
    ],
)
def test_invalid_packet_is_rejected_before_anything_is_sent(
    destination: int, rate: int, frames: list[bytes], field: str
) -> None:
    modem = ready()
    with pytest.raises(FrameError) as caught:
        modem.driver.send_packet(destination, rate, frames, now=modem.now)
    assert caught.value.field == field
    modem.run(10.0)
    assert modem.received == []


EXCHANGE = [("CCCYC", 1), ("CACYC", 1), ("CADRQ", 1), ("CCTXD", 1), ("CATXD", 1), ("CADRQ", 2), ("CCTXD", 2),
            ("CATXD", 2), ("CATXP", 1), ("CATXF", 1), ("CAXST", 1)]  # fmt: skip
HARMLESS = {"CCCYC", "CACYC", "CATXD", "CATXP", "CATXF", "CAXST"}


@pytest.mark.parametrize("reports", [True, False], ids=["errors reported", "errors not reported"])
@pytest.mark.parametrize(("kind", "nth"), EXCHANGE)
def test_next_packet_is_sent_after_any_lost_sentence(kind: str, nth: int, reports: bool) -> None:
    """Without CAERR from the modem, the time-outs of the driver end the cycle."""
    modem = ready(drop_nth(kind, nth))
    modem.silent_kinds.update(() if reports else ("CAERR",))
    first, second = send(modem, FIRST), send(modem, SECOND)
    modem.run(90.0)
    outcomes = modem.events_of(PacketSent, PacketFailed)
    assert [event.packet_id for event in outcomes] == [first, second]
    assert isinstance(outcomes[1], PacketSent)
    assert modem.transmitted[-1] == tuple(SECOND)
    if not reports:
        return
    assert isinstance(outcomes[0], PacketSent if kind in HARMLESS else PacketFailed)
    if isinstance(outcomes[0], PacketSent):
        assert modem.transmitted == [tuple(FIRST), tuple(SECOND)], "a packet reported as sent was transmitted"
    else:
        assert outcomes[0].reason is FailureReason.DATA_TIMEOUT
        assert modem.transmitted == [tuple(SECOND)]
    assert outcomes[1].finished_s < 30.0
    assert modem.driver.queued == 0


@pytest.mark.parametrize(
    ("kinds", "reason", "maybe_sent"),
    [
        ({"CCCYC"}, FailureReason.NO_ECHO, False),
        ({"CADRQ", "CAERR"}, FailureReason.NO_DATA_REQUEST, False),
        ({"CATXD", "CADRQ2", "CATXP", "CATXF", "CAXST", "CAERR"}, FailureReason.NO_DATA_ECHO, True),
    ],
)
def test_every_timeout_has_its_reason(kinds: set[str], reason: FailureReason, maybe_sent: bool) -> None:
    modem = ready(lambda sentence, _: sentence.kind in kinds)
    packet_id = send(modem, [b"x"])
    modem.run(50.0)
    (failed,) = modem.events_of(PacketFailed)
    assert (failed.packet_id, failed.reason, failed.maybe_sent) == (packet_id, reason, maybe_sent)
    assert modem.events_of(ModemUnresponsive) == []
    modem.drops = drop_nothing
    send(modem, SECOND)
    modem.run(100.0)
    assert len(modem.events_of(PacketSent)) == 1


def test_modem_is_queried_after_a_failed_packet() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CADRQ" and modem.now < 9.0)
    send(modem, FIRST)
    send(modem, SECOND)
    modem.run(40.0)
    assert [s.kind for s in modem.received] == ["CCCYC", "CCCFQ", "CCCYC", "CCTXD", "CCTXD"]


def test_repeated_data_request_is_answered_again() -> None:
    modem = ready(drop_nth("CCTXD", 1))
    send(modem, FIRST)
    modem.schedule(1.0, modem.request_data)
    modem.run(20.0)
    assert modem.transmitted == [tuple(FIRST)]
    assert len(modem.events_of(PacketSent)) == 1


def test_data_request_for_fewer_bytes_fails_the_packet() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CADRQ")
    send(modem, FIRST)
    modem.schedule(0.2, lambda: modem.driver.receive(b"", modem.now))
    modem.schedule(0.3, lambda: setattr(modem, "drops", drop_nothing))
    modem.schedule(0.4, lambda: modem.send("CADRQ", "000000", 3, 1, 0, 64, 1))
    modem.run(6.0)
    assert modem.commands("CCTXD")[0] == ("3", "1", "0", "")
    (failed,) = modem.events_of(PacketFailed)
    assert failed.reason is FailureReason.FRAME_REFUSED


def test_partially_accepted_frame_fails_the_packet() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CATXD")
    send(modem, [b"abcdef"], 0)
    modem.schedule(0.16, lambda: modem.send_bytes(nmea.format("CATXD", 3, 1, 0, 5)))
    modem.run(30.0)
    (failed,) = modem.events_of(PacketFailed)
    assert (failed.reason, failed.maybe_sent) == (FailureReason.FRAME_REFUSED, True)


def test_late_data_request_gets_an_empty_answer() -> None:
    modem = ready()
    modem.send("CADRQ", "000000", 3, 1, 0, 256, 1)
    modem.run(5.5)
    assert modem.commands("CCTXD") == [("3", "1", "0", "")]
    assert modem.events == []


@pytest.mark.parametrize("moment_s", [0.02, 0.12, 2.0])
def test_restart_during_a_cycle(moment_s: float) -> None:
    modem = ready()
    first, second = send(modem, FIRST), send(modem, SECOND)

    def restart() -> None:
        modem.forget()
        modem.settings = {}
        modem.send("CAREV", "000001", "INIT", "2.0.27087")

    modem.schedule(moment_s, restart)
    modem.run(60.0)
    failed, rebooted, is_ready, sent = modem.events
    assert isinstance(failed, PacketFailed)
    assert (failed.packet_id, failed.reason) == (first, FailureReason.REBOOTED)
    assert failed.maybe_sent == (moment_s > 0.1)
    assert rebooted == ModemRebooted("2.0.27087")
    assert is_ready == ModemReady(3, "2.0.27087")
    assert isinstance(sent, PacketSent)
    assert sent.packet_id == second
    assert modem.settings["SRC"] == "3"


def test_port_lost_during_a_cycle_and_reopened() -> None:
    modem = ready()
    first, second = send(modem, FIRST), send(modem, SECOND)
    modem.run(6.0)
    modem.driver.port_lost(6.0)
    assert modem.driver.next_wakeup() <= 6.0, "an event is pending"
    (failed,) = modem.driver.poll(6.0)
    assert (failed.packet_id, failed.reason) == (first, FailureReason.PORT_LOST)
    modem.forget()
    modem.run(20.0)
    modem.driver.port_opened(20.0)
    modem.run(60.0)
    assert [e.packet_id for e in modem.events_of(PacketSent)] == [second]


def test_transmission_with_a_missing_frame_fails_the_packet() -> None:
    """The request for the second frame is lost, and this firmware transmits without it."""
    modem = ready(
        lambda sentence, _: sentence.kind == "CAERR" or (sentence.kind, sentence.fields[-1:]) == ("CADRQ", ("2",))
    )
    send(modem, FIRST)
    modem.schedule(2.0, modem.transmit)
    modem.run(20.0)
    (failed,) = modem.events_of(PacketFailed)
    assert (failed.reason, failed.maybe_sent) == (FailureReason.DATA_TIMEOUT, True)
    assert modem.transmitted == [(FIRST[0],)]


def test_no_cycle_starts_during_another_transmission() -> None:
    modem = ready()
    modem.send("CATXP", 32)
    send(modem, FIRST)
    modem.run(8.0)
    assert modem.received == []
    modem.send("CATXF", 32)
    modem.run(8.05)
    assert [s.kind for s in modem.received] == ["CCCYC"]
    modem = ready()
    modem.send("CATXP", 32)
    send(modem, FIRST)
    modem.run(5.0 + CONFIG.on_air_limit_s(None) + 6.0)
    assert len(modem.events_of(PacketSent)) == 1, "the wait is bounded when CATXF is lost"


def test_rate_0_header_does_not_end_the_cycle() -> None:
    driver = MicroModem(MicroModemConfig(address=3, settings=()))
    driver.port_opened(0.0)
    for answer in (b"$CACFG,SRC,3\r\n", b"$CACFG,CST,1\r\n") * 2:
        driver.receive(answer, 0.0)
    driver.send_packet(1, 0, [b"x"], now=0.0)
    xst = b"$CAXST,7,20250606,230117.336548,3,0,200,5000,25000,0,3,1,0,1,1,%d,1\r\n"
    events = []
    for now, line in enumerate(
        [b"$CACYC,0,3,1,0,0,1\r\n", b"$CATXP,0\r\n", b"$CATXF,0\r\n", xst % 2, b"$CADRQ,000000,3,1,0,32,1\r\n",
         b"$CATXD,3,1,0,1\r\n", b"$CATXP,1\r\n", xst % 2, b"$CATXF,1\r\n"]
    ):  # fmt: skip
        events += driver.receive(line, float(now))
        assert driver.queued == 1
    assert [type(event) for event in events] == [TransmissionStarted, TransmissionEnded] * 2
    (sent,) = driver.receive(xst % 1, 10.0)
    assert isinstance(sent, PacketSent)


def test_invalid_statistics_end_the_cycle() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CAXST" and sentence.fields[0] == "7")
    send(modem, FIRST)
    modem.schedule(3.6, lambda: modem.send("CAXST", 8, *[""] * 13, "what"))
    modem.run(9.0)
    assert [type(event) for event in modem.events] == [SentenceRejected, PacketSent]


def test_statistics_outside_an_exchange_are_ignored() -> None:
    modem = ready()
    modem.send("CAXST", 7, "20250606", "230117.336548")
    assert modem.events == []


def acknowledge(modem: FakeModem, *numbers: int, src: int = 1) -> None:
    modem.send("CARXP", 1)
    for number in numbers:
        modem.send("CAACK", src, 3, number, 1)
    modem.send("CACST", 6, 0)


def test_packet_waits_for_its_acknowledgements() -> None:
    modem = ready()
    send(modem, FIRST, ack=True)
    send(modem, SECOND)
    modem.schedule(6.0, lambda: acknowledge(modem, 1, 2))
    modem.run(11.5)
    (sent,) = modem.events_of(PacketSent)
    assert sent.acknowledged == (1, 2)
    assert modem.commands("CCCYC")[0][4] == "1"
    assert modem.commands("CCTXD")[0][2] == "1"
    modem.run(20.0)
    assert len(modem.events_of(PacketSent)) == 2


@pytest.mark.parametrize(
    ("numbers", "src", "acknowledged"), [((), 1, ()), ((2,), 1, (2,)), ((1, 2), 7, ()), ((9,), 1, ())]
)
def test_missing_acknowledgements_delay_the_packet(numbers, src: int, acknowledged: tuple[int, ...]) -> None:
    modem = ready()
    send(modem, FIRST, ack=True)
    send(modem, SECOND)
    modem.schedule(6.0, lambda: acknowledge(modem, *numbers, src=src))
    modem.run(5.0 + 4.0 + CONFIG.ack_wait_s + 6.0)
    assert [event.acknowledged for event in modem.events_of(PacketSent)] == [acknowledged, ()]


def test_queue_is_bounded_and_ordered() -> None:
    modem = ready(config=MicroModemConfig(address=3, queued_packets=2))
    ids = [send(modem, [bytes([n])]) for n in range(5)]
    modem.run(60.0)
    full = modem.events_of(PacketFailed)
    assert [event.packet_id for event in full] == ids[3:]
    assert {event.reason for event in full} == {FailureReason.QUEUE_FULL}
    assert [event.packet_id for event in modem.events_of(PacketSent)] == ids[:3], "one in progress, two queued"


def test_error_of_the_modem_is_reported() -> None:
    modem = ready()
    modem.send("CAERR", "181807", "NMEA", 2, "no such thing")
    (complained,) = modem.events
    assert isinstance(complained, ModemError)
    assert complained.text == "NMEA, 2, no such thing"


@given(st.lists(st.integers(0, 60), max_size=8), st.integers(1, 6))
def test_every_packet_has_one_result_whatever_sentences_are_lost(lost: list[int], packets: int) -> None:
    """Any sentences are lost in both directions; afterwards the line is undisturbed."""
    seen = iter(range(10**9))
    modem = ready()
    modem.drops = lambda sentence, _: next(seen) in lost
    ids = [send(modem, [bytes([n]) * 20, b"z"]) for n in range(packets)]
    modem.run(400.0)
    assert sorted(event.packet_id for event in modem.events_of(PacketSent, PacketFailed)) == ids
    assert modem.driver.queued == 0
    modem.drops = drop_nothing
    modem.run(600.0)
    last = send(modem, SECOND)
    modem.run(660.0)
    assert modem.events_of(PacketSent, PacketFailed)[-1].packet_id == last
    assert modem.events_of(PacketSent)[-1].packet_id == last
    assert modem.driver.ready


def test_factory_address_during_a_cycle_is_treated_as_a_restart() -> None:
    """After a restart whose INIT was lost, the modem has its factory address."""
    modem = ready()
    first, second = send(modem, FIRST), send(modem, SECOND)
    modem.run(6.0)
    modem.forget()
    modem.send("CACFG", "SRC", 0)
    assert [(e.packet_id, e.reason) for e in modem.events_of(PacketFailed)] == [(first, FailureReason.REBOOTED)]
    modem.run(30.0)
    assert [event.packet_id for event in modem.events_of(PacketSent)] == [second]


def test_rate_0_data_request_may_follow_the_header() -> None:
    modem = ready(lambda sentence, _: sentence.kind in {"CADRQ", "CAERR"})
    send(modem, [b"x"], 0)
    modem.run(5.0 + CONFIG.request_timeout_s + CONFIG.airtime_s(0))
    assert modem.events == []
    modem.send("CACFG", "X", 1)
    modem.run(40.0)
    assert [event.reason for event in modem.events_of(PacketFailed)] == [FailureReason.NO_DATA_REQUEST]


def test_late_echo_of_the_own_command_is_not_a_reception() -> None:
    modem = ready()
    modem.send("CACYC", 0, 3, 1, 4, 0, 2)
    assert modem.events == []
    assert not modem.driver.receiving
