import pytest
from builders.fake_modem import FakeModem, Loses, never, nth_of
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError
from sonarpost.modem.micromodem import (
    RATES,
    FailureReason,
    FrameAcknowledged,
    MicroModem,
    MicroModemConfig,
    ModemError,
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketSent,
    SentenceRejected,
    UnhandledSentence,
    nmea,
)

CONFIG = MicroModemConfig(address=3)
FIRST = [b"a" * 256, b"b"]
SECOND = [b"c" * 256, b"d"]


def ready(loses: Loses = never, config: MicroModemConfig = CONFIG) -> FakeModem:
    modem = FakeModem(MicroModem(config), loses)
    modem.driver.start(0.0)
    modem.run(5.0)
    assert modem.events == [ModemReady(3, None)]
    modem.events.clear()
    modem.heard.clear()
    return modem


def send(modem: FakeModem, frames: list[bytes], rate: int = 4, **options) -> int:
    return modem.driver.send_packet(1, rate, frames, now=modem.now, **options)


def test_bytes_of_a_whole_cycle() -> None:
    driver = MicroModem(MicroModemConfig(address=2, settings=()))
    driver.start(0.0)
    for answer in (b"$CACFG,SRC,2\r\n", b"$CACFG,CST,1\r\n") * 2:
        driver.bytes_to_send()
        driver.receive(answer, 0.0)
    packet_id = driver.send_packet(1, 0, [b"\x00\xffA"], ack=True, now=1.0)
    assert driver.bytes_to_send() == b"$CCCYC,0,2,1,0,1,1*5A\r\n"
    assert driver.receive(b"$CACYC,0,2,1,0,1,1\r\n", 1.1) == []
    assert driver.receive(b"$CADRQ,000001,2,1,1,32,1\r\n", 1.2) == []
    assert driver.bytes_to_send() == b"$CCTXD,2,1,1,00FF41*7F\r\n"
    for line in (b"$CATXD,2,1,1,3\r\n", b"$CATXP,3\r\n", b"$CATXF,3\r\n"):
        assert driver.receive(line, 2.0) == []
    assert driver.receive(b"$CAXST,7,20250606,230117.336548,3,0,200,5000,25000,0,2,1,1,1,1,1,3\r\n", 5.0) == []
    *_, sent = driver.receive(b"$CAACK,1,2,1,1\r\n", 9.0)
    assert isinstance(sent, PacketSent)
    assert (sent.packet_id, sent.dest, sent.rate, sent.frames) == (packet_id, 1, 0, (b"\x00\xffA",))
    assert (sent.acknowledged, sent.started_s, sent.finished_s) == ((1,), 1.0, 9.0)
    assert sent.statistics is not None
    assert sent.statistics.nbytes == 3


@pytest.mark.parametrize("rate", RATES)
def test_full_packet_of_every_rate(rate: int) -> None:
    modem = ready()
    frames = [bytes([n]) * RATES[rate].frame_bytes for n in range(RATES[rate].frames)]
    send(modem, frames, rate)
    modem.run(20.0)
    assert modem.on_air == [tuple(frames)]
    (sent,) = modem.events
    assert sent.frames == tuple(frames)
    assert modem.driver.queued == 0


def test_empty_frame_is_sent_as_empty_hex() -> None:
    modem = ready()
    send(modem, [b"x", b""])
    modem.run(20.0)
    assert modem.commands("CCTXD") == [("3", "1", "0", "78"), ("3", "1", "0", "")]
    assert len(modem.of(PacketSent)) == 1


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
def test_refused_before_anything_is_sent(destination: int, rate: int, frames: list[bytes], field: str) -> None:
    modem = ready()
    with pytest.raises(FrameError) as caught:
        modem.driver.send_packet(destination, rate, frames, now=modem.now)
    assert caught.value.field == field
    modem.run(10.0)
    assert modem.heard == []


EXCHANGE = [("CCCYC", 1), ("CACYC", 1), ("CADRQ", 1), ("CCTXD", 1), ("CATXD", 1), ("CADRQ", 2), ("CCTXD", 2),
            ("CATXD", 2), ("CATXP", 1), ("CATXF", 1), ("CAXST", 1)]  # fmt: skip
HARMLESS = {"CCCYC", "CACYC", "CATXD", "CATXP", "CATXF", "CAXST"}


@pytest.mark.parametrize(("kind", "nth"), EXCHANGE)
def test_any_sentence_lost_once_and_the_next_packet_goes(kind: str, nth: int) -> None:
    modem = ready(nth_of(kind, nth))
    first, second = send(modem, FIRST), send(modem, SECOND)
    modem.run(60.0)
    outcomes = modem.of(PacketSent, PacketFailed)
    assert [event.packet_id for event in outcomes] == [first, second]
    assert isinstance(outcomes[1], PacketSent)
    assert modem.on_air[-1] == tuple(SECOND)
    assert isinstance(outcomes[0], PacketSent if kind in HARMLESS else PacketFailed)
    if isinstance(outcomes[0], PacketSent):
        assert modem.on_air == [tuple(FIRST), tuple(SECOND)], "what is reported as sent was on the air"
    else:
        assert outcomes[0].reason is FailureReason.DATA_TIMEOUT
        assert modem.on_air == [tuple(SECOND)]
    assert outcomes[1].finished_s < 30.0
    assert modem.driver.queued == 0


@pytest.mark.parametrize(("kind", "nth"), EXCHANGE)
def test_a_sentence_lost_to_a_modem_that_does_not_complain(kind: str, nth: int) -> None:
    """Without CAERR and with a host whose time-outs are all it has, the next packet goes all the same."""
    modem = ready(nth_of(kind, nth))
    modem.silent_kinds.add("CAERR")
    send(modem, FIRST)
    send(modem, SECOND)
    modem.run(90.0)
    outcomes = modem.of(PacketSent, PacketFailed)
    assert len(outcomes) == 2
    assert isinstance(outcomes[1], PacketSent)
    assert modem.on_air[-1] == tuple(SECOND)


@pytest.mark.parametrize(
    ("kinds", "reason", "maybe_sent"),
    [
        ({"CCCYC"}, FailureReason.NO_ECHO, False),
        ({"CADRQ", "CAERR"}, FailureReason.NO_DATA_REQUEST, False),
        ({"CATXD", "CADRQ2", "CATXP", "CATXF", "CAXST", "CAERR"}, FailureReason.NO_DATA_ECHO, True),
        ({"CATXP", "CATXF", "CAXST"}, FailureReason.NO_TRANSMIT_START, True),
        ({"CATXF", "CAXST"}, FailureReason.NO_TRANSMIT_END, True),
    ],
)
def test_every_wait_has_its_end_and_its_reason(kinds: set[str], reason: FailureReason, maybe_sent: bool) -> None:
    modem = ready(lambda sentence, _: sentence.kind in kinds)
    packet_id = send(modem, [b"x"])
    modem.run(50.0)
    (failed,) = modem.of(PacketFailed)
    assert (failed.packet_id, failed.reason, failed.maybe_sent) == (packet_id, reason, maybe_sent)
    assert modem.of(ModemUnresponsive) == []
    modem.loses = never
    send(modem, SECOND)
    modem.run(100.0)
    assert len(modem.of(PacketSent)) == 1


def test_after_a_failed_packet_the_modem_is_asked_before_the_next() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CADRQ" and modem.now < 9.0)
    send(modem, FIRST)
    send(modem, SECOND)
    modem.run(40.0)
    assert [s.kind for s in modem.heard] == ["CCCYC", "CCCFQ", "CCCYC", "CCTXD", "CCTXD"]


def test_modem_that_asks_again_is_answered_again() -> None:
    modem = ready(nth_of("CCTXD", 1))
    send(modem, FIRST)
    modem.later(1.0, modem._ask)
    modem.run(20.0)
    assert modem.on_air == [tuple(FIRST)]
    assert len(modem.of(PacketSent)) == 1


def test_modem_that_wants_fewer_bytes() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CADRQ")
    send(modem, FIRST)
    modem.later(0.2, lambda: modem.driver.receive(b"", modem.now))
    modem.later(0.3, lambda: setattr(modem, "loses", never))
    modem.later(0.4, lambda: modem.say("CADRQ", "000000", 3, 1, 0, 64, 1))
    modem.run(6.0)
    assert modem.commands("CCTXD")[0] == ("3", "1", "0", "")
    (failed,) = modem.of(PacketFailed)
    assert failed.reason is FailureReason.FRAME_REFUSED


def test_modem_that_took_only_part_of_a_frame() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CATXD")
    send(modem, [b"abcdef"], 0)
    modem.later(0.16, lambda: modem.raw(nmea.format("CATXD", 3, 1, 0, 5)))
    modem.run(30.0)
    (failed,) = modem.of(PacketFailed)
    assert (failed.reason, failed.maybe_sent) == (FailureReason.FRAME_REFUSED, True)


def test_late_request_of_a_given_up_cycle_gets_an_empty_answer() -> None:
    modem = ready()
    modem.say("CADRQ", "000000", 3, 1, 0, 256, 1)
    modem.run(5.5)
    assert modem.commands("CCTXD") == [("3", "1", "0", "")]
    assert modem.events == []


@pytest.mark.parametrize("moment_s", [0.02, 0.07, 0.12, 0.3, 2.0, 3.4])
def test_restart_in_the_middle_of_a_cycle(moment_s: float) -> None:
    modem = ready()
    first, second = send(modem, FIRST), send(modem, SECOND)

    def restart() -> None:
        modem._cycle = None
        modem._cycle_number += 1
        modem._due = []
        modem.settings = {}
        modem.say("CAREV", "000001", "INIT", "2.0.27087")

    modem.later(moment_s, restart)
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


def test_port_lost_in_the_middle_and_back() -> None:
    modem = ready()
    first, second = send(modem, FIRST), send(modem, SECOND)
    modem.run(6.0)
    modem.driver.port_lost(6.0)
    assert modem.driver.next_wakeup() <= 6.0, "there is something to tell"
    (failed,) = modem.driver.poll(6.0)
    assert (failed.packet_id, failed.reason) == (first, FailureReason.PORT_LOST)
    modem._cycle, modem._due = None, []
    modem.run(20.0)
    modem.driver.port_opened(20.0)
    modem.run(60.0)
    assert [e.packet_id for e in modem.of(PacketSent)] == [second]


def test_frames_of_a_modem_that_goes_on_without_one() -> None:
    """The request for the second frame is lost, and this firmware transmits what it has."""
    modem = ready(
        lambda sentence, _: sentence.kind == "CAERR" or (sentence.kind, sentence.fields[-1:]) == ("CADRQ", ("2",))
    )
    send(modem, FIRST)
    modem.later(2.0, modem._transmit)
    modem.run(20.0)
    (failed,) = modem.of(PacketFailed)
    assert (failed.reason, failed.maybe_sent) == (FailureReason.DATA_TIMEOUT, True)
    assert modem.on_air == [(FIRST[0],)]


def test_nothing_is_sent_while_the_modem_transmits_something_else() -> None:
    modem = ready()
    modem.say("CATXP", 32)
    send(modem, FIRST)
    modem.run(8.0)
    assert modem.heard == []
    modem.say("CATXF", 32)
    modem.run(8.05)
    assert [s.kind for s in modem.heard] == ["CCCYC"]
    modem = ready()
    modem.say("CATXP", 32)
    send(modem, FIRST)
    modem.run(5.0 + CONFIG.on_air_limit_s(None) + 6.0)
    assert len(modem.of(PacketSent)) == 1, "the end of it may get lost"


def test_rate_0_announces_itself_with_a_transmission_of_its_own() -> None:
    driver = MicroModem(MicroModemConfig(address=3, settings=()))
    driver.start(0.0)
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
    assert events == []
    (sent,) = driver.receive(xst % 1, 10.0)
    assert isinstance(sent, PacketSent)


def test_unreadable_statistics_still_end_the_cycle() -> None:
    modem = ready(lambda sentence, _: sentence.kind == "CAXST" and sentence.fields[0] == "7")
    send(modem, FIRST)
    modem.later(3.6, lambda: modem.say("CAXST", "seven", "", ""))
    modem.run(9.0)
    assert [type(event) for event in modem.events] == [SentenceRejected, PacketSent]
    assert modem.events[1].statistics is None


def test_statistics_of_nothing_are_passed_on() -> None:
    modem = ready()
    modem.say("CAXST", 7, "20250606", "230117.336548")
    assert [type(event) for event in modem.events] == [UnhandledSentence]


def acknowledge(modem: FakeModem, *numbers: int, src: int = 1) -> None:
    modem.say("CARXP", 1)
    for number in numbers:
        modem.say("CAACK", src, 3, number, 1)
    modem.say("CACST", 6, 0)


def test_acknowledgements_are_waited_for() -> None:
    modem = ready()
    send(modem, FIRST, ack=True)
    send(modem, SECOND)
    modem.later(6.0, lambda: acknowledge(modem, 1, 2))
    modem.run(11.5)
    (sent,) = modem.of(PacketSent)
    assert sent.acknowledged == (1, 2)
    assert modem.of(FrameAcknowledged) == [FrameAcknowledged(1, 3, 1), FrameAcknowledged(1, 3, 2)]
    assert modem.commands("CCCYC")[0][4] == "1"
    assert modem.commands("CCTXD")[0][2] == "1"
    modem.run(20.0)
    assert len(modem.of(PacketSent)) == 2


@pytest.mark.parametrize(
    ("numbers", "src", "acknowledged"), [((), 1, ()), ((2,), 1, (2,)), ((1, 2), 7, ()), ((9,), 1, ())]
)
def test_missing_acknowledgements_cost_only_time(numbers, src: int, acknowledged: tuple[int, ...]) -> None:
    modem = ready()
    send(modem, FIRST, ack=True)
    send(modem, SECOND)
    modem.later(6.0, lambda: acknowledge(modem, *numbers, src=src))
    modem.run(5.0 + 4.0 + CONFIG.ack_wait_s + 6.0)
    assert [event.acknowledged for event in modem.of(PacketSent)] == [acknowledged, ()]


def test_queue_is_bounded_and_keeps_its_order() -> None:
    modem = ready(config=MicroModemConfig(address=3, queued_packets=2))
    ids = [send(modem, [bytes([n])]) for n in range(5)]
    modem.run(60.0)
    full = modem.of(PacketFailed)
    assert [event.packet_id for event in full] == ids[3:]
    assert {event.reason for event in full} == {FailureReason.QUEUE_FULL}
    assert [event.packet_id for event in modem.of(PacketSent)] == ids[:3], "one on its way, two waiting"


def test_complaint_of_the_modem_is_passed_on() -> None:
    modem = ready()
    modem.say("CAERR", "181807", "NMEA", 2, "no such thing")
    (complained,) = modem.events
    assert isinstance(complained, ModemError)
    assert complained.report.number == 2


@given(st.lists(st.integers(0, 60), max_size=8), st.integers(1, 6))
def test_whatever_is_lost_every_packet_has_one_outcome_and_the_last_goes(lost: list[int], packets: int) -> None:
    """Any sentences of the exchange are lost, in both directions; then the line is good again."""
    seen = iter(range(10**9))
    modem = ready()
    modem.loses = lambda sentence, _: next(seen) in lost
    ids = [send(modem, [bytes([n]) * 20, b"z"]) for n in range(packets)]
    modem.run(400.0)
    assert sorted(event.packet_id for event in modem.of(PacketSent, PacketFailed)) == ids
    assert modem.driver.queued == 0
    modem.loses = never
    modem.run(600.0)
    last = send(modem, SECOND)
    modem.run(660.0)
    assert modem.events[-1].packet_id == last
    assert isinstance(modem.events[-1], PacketSent)
    assert modem.driver.ready


def test_address_lost_in_the_middle_of_a_cycle() -> None:
    """A restart whose INIT was lost shows itself by the factory address."""
    modem = ready()
    first, second = send(modem, FIRST), send(modem, SECOND)
    modem.run(6.0)
    modem._cycle, modem._due = None, []
    modem.say("CACFG", "SRC", 0)
    assert [(e.packet_id, e.reason) for e in modem.of(PacketFailed)] == [(first, FailureReason.REBOOTED)]
    modem.run(30.0)
    assert [event.packet_id for event in modem.of(PacketSent)] == [second]


def test_rate_0_is_given_the_time_its_announcement_takes() -> None:
    modem = ready(lambda sentence, _: sentence.kind in {"CADRQ", "CAERR"})
    send(modem, [b"x"], 0)
    modem.run(5.0 + CONFIG.request_timeout_s + CONFIG.airtime_s(0))
    assert modem.events == []
    modem.say("CACFG", "X", 1)
    modem.run(40.0)
    assert [event.reason for event in modem.of(PacketFailed)] == [FailureReason.NO_DATA_REQUEST]


def test_late_echo_of_our_own_command_is_no_reception() -> None:
    modem = ready()
    modem.say("CACYC", 0, 3, 1, 4, 0, 2)
    assert [type(event) for event in modem.events] == [UnhandledSentence]
    assert not modem.driver.receiving
