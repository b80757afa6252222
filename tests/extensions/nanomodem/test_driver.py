"""The nanomodem driver: its messages, and its dialogue with the modem."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError, SentenceError
from sonarpost.extensions.nanomodem.driver import ANSWER_LIMIT_S, CHECK_INTERVAL_S, GUARD_S, PAUSE_S, NanoModem
from sonarpost.extensions.nanomodem.messages import (
    Answer,
    Confirmation,
    NanoData,
    NanoMessage,
    NanoMessageAssembler,
    NoAnswer,
    Refusal,
    Status,
)
from sonarpost.extensions.nanomodem.rates import RATES, airtime_s
from sonarpost.modem.interface import (
    FrameReceived,
    ModemError,
    ModemEvent,
    ModemReady,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketReceived,
    PacketSent,
    RangeMeasured,
    RequestDone,
    RequestFailed,
    SentenceRejected,
    TransmissionEnded,
    TransmissionStarted,
)
from sonarpost.modem.registry import ModemSettings

GOLDEN: list[tuple[bytes, NanoMessage]] = [
    (b"#A255V21941\r\n", Status(255, None)),
    (b"#A007\r\n", Status(7, None)),
    (b"#A007V21941R001.001.003B2021-06-01T12:00:00\r\n", Status(7, "001.001.003")),
    (b"$B02\r\n", Confirmation(b"$B02")),
    (b"$U12364\r\n", Confirmation(b"$U12364")),
    (b"$M00305\r\n", Confirmation(b"$M00305")),
    (b"$P003\r\n", Confirmation(b"$P003")),
    (b"#B00305hello\r\n", NanoData(3, b"hello")),
    (b"#U05hello\r\n", NanoData(None, b"hello")),
    (b"#B00305helloQ12D-123T00000000012345\r\n", NanoData(3, b"hello")),
    (b"#B00307\r\n#TO\r\n\r\n", NanoData(3, b"\r\n#TO\r\n")),
    (b"#B00315#U03abc\r\n#A001$\r\n", NanoData(3, b"#U03abc\r\n#A001$")),
    (b"#R003T01600\r\n", Answer(3, 0.05)),
    (b"#R003T99999Q12D0123\r\n", Answer(3, 99_999 * 31.25e-6)),
    (b"#TO\r\n", NoAnswer()),
    (b"E\r\n", Refusal()),
]


def each_byte(data: bytes) -> list[NanoMessage | SentenceError]:
    assembler = NanoMessageAssembler()
    return [item for index in range(len(data)) for item in assembler.feed(data[index : index + 1])]


@pytest.mark.parametrize(("data", "message"), GOLDEN)
def test_message_whole_by_byte_and_with_trailing_junk(data: bytes, message: NanoMessage) -> None:
    assert NanoMessageAssembler().feed(data * 2) == [message] * 2
    assert each_byte(data) == [message]
    assembler = NanoMessageAssembler()
    first, error = assembler.feed(data + b"!junk!")
    assert first == message
    assert isinstance(error, SentenceError)
    assert not assembler.incomplete


@pytest.mark.parametrize(
    ("data", "field"),
    [
        (b"#B25605hello\r\n", "address"),
        (b"#B0x305hello\r\n", "address"),
        (b"#B00365" + bytes(65) + b"\r\n", "length"),
        (b"#B00300\r\n", "length"),
        (b"#U-1a\r\n", "length"),
        (b"#B00304hello\r\n", "text"),
        (b"#R003T1234x\r\n", "travel time"),
        (b"#R999T12345\r\n", "address"),
        (b"#A256\r\n", "address"),
        (b"#A001" + b"x" * 65 + b"\r\n", "text"),
        (b"$B65\r\n", "length"),
        (b"$CAREV,000000,AUV,0.94.0.0*1D\r\n", "kind"),
        (b"Error\r\n", "text"),
    ],
)
def test_invalid_message_is_one_error_and_the_next_is_read(data: bytes, field: str) -> None:
    found = NanoMessageAssembler().feed(data + b"#TO\r\n")
    assert found[-1] == NoAnswer()
    [error] = found[:-1]
    assert isinstance(error, SentenceError)
    assert error.field == field


def test_cut_message_does_not_hide_the_next_one() -> None:
    assert NanoMessageAssembler().feed(b"#B00320hello#B00405world\r\n#TO\r\n")[-2:] == [
        NanoData(4, b"world"),
        NoAnswer(),
    ]
    assembler = NanoMessageAssembler()
    assert assembler.feed(b"#B00364hello#B00405world\r\n#TO\r\n") == []
    error, *found = assembler.abandon()
    assert isinstance(error, SentenceError)
    assert found == [NanoData(4, b"world"), NoAnswer()]
    assert assembler.abandon() == []


messages = st.sampled_from([data for data, _ in GOLDEN])
sentence_like = st.text("#$EBUMPRTAO0123456789\r\n").map(str.encode)
noise = st.binary(max_size=80) | messages | messages.map(lambda data: data[:-3]) | sentence_like


@given(st.lists(noise, max_size=8).map(b"".join), st.data())
def test_any_bytes_in_any_parts_give_the_same_messages(data: bytes, draw: st.DataObject) -> None:
    whole, parts = NanoMessageAssembler(), NanoMessageAssembler()
    expected = [item for item in whole.feed(data) + whole.abandon() if not isinstance(item, SentenceError)]
    found: list[NanoMessage | SentenceError] = []
    at = 0
    while at < len(data):
        size = draw.draw(st.integers(1, 40))
        found += parts.feed(data[at : at + size])
        at += size
        assert len(parts._buffer) < 110, "an incomplete message is bounded"
    found += parts.abandon()
    assert [item for item in found if not isinstance(item, SentenceError)] == expected
    for item in expected:
        if isinstance(item, NanoData):
            assert 1 <= len(item.data) <= 64
            assert item.source is None or 0 <= item.source <= 255


@given(st.binary(min_size=1, max_size=64), st.integers(0, 255))
def test_data_of_any_bytes(data: bytes, source: int) -> None:
    assert each_byte(b"#B%03d%02d%b\r\n" % (source, len(data), data)) == [NanoData(source, data)]


def take(driver: NanoModem) -> bytes:
    return b"".join(iter(driver.bytes_to_send, b""))


def kinds(events: list[ModemEvent]) -> list[str]:
    return [type(event).__name__ for event in events]


@pytest.fixture
def driver() -> NanoModem:
    driver = NanoModem(ModemSettings(3))
    driver.port_opened(0.0)
    assert take(driver) == b"$?"
    [ready] = driver.receive(b"#A003V21941R1.2\r\n", 0.0)
    assert ready == ModemReady(3, "1.2")
    assert driver.ready
    return driver


def test_address_is_set_when_the_modem_has_another() -> None:
    driver = NanoModem(ModemSettings(3))
    driver.port_opened(0.0)
    assert take(driver) == b"$?"
    assert driver.receive(b"#A255V21941\r\n", 0.1) == []
    assert take(driver) == b"$A003"
    assert driver.receive(b"#A255\r\n", 0.2) == []
    assert take(driver) == b"", "a wrong answer waits for the timeout"
    assert driver.poll(5.2) == []
    assert take(driver) == b"$A003"
    assert driver.receive(b"#A003\r\n", 5.3) == [ModemReady(3, None)]


def test_silent_modem_is_reported_once_and_asked_again() -> None:
    driver = NanoModem(ModemSettings(3))
    driver.port_opened(0.0)
    events = [event for second in range(60) for event in driver.poll(float(second))]
    assert events == [ModemUnresponsive("$?", 3, None)]
    assert take(driver) == b"$?" * 12
    assert kinds(driver.receive(b"#A003V21941\r\n", 60.0)) == ["ModemReady"]


def test_packet_is_a_broadcast_with_the_destination_and_takes_its_air_time(driver: NanoModem) -> None:
    number = driver.send_packet(1, 1, [b"hello"], now=1.0)
    assert take(driver) == b"$B06\x01hello"
    [started] = driver.receive(b"$B06\r\n", 1.1)
    assert started == TransmissionStarted(airtime_s(6))
    end_s = 1.1 + airtime_s(6) + GUARD_S
    assert driver.next_wakeup() == pytest.approx(end_s)
    assert driver.poll(end_s - 0.01) == []
    ended, sent = driver.poll(end_s)
    assert isinstance(ended, TransmissionEnded)
    assert isinstance(sent, PacketSent)
    assert (sent.packet_id, sent.acknowledged, driver.queued) == (number, (), 0)


def test_full_and_empty_frames(driver: NanoModem) -> None:
    assert RATES[1].throughput_bps == pytest.approx(456, abs=1)
    driver.send_packet(255, 1, [bytes(range(63))], now=1.0)
    assert take(driver) == b"$B64\xff" + bytes(range(63))
    driver.receive(b"$B64\r\n", 1.0)
    driver.send_packet(255, 1, [b""], now=1.0)
    driver.poll(3.0)
    assert take(driver) == b"$B02\xff\0"
    with pytest.raises(FrameError, match="64"):
        driver.send_packet(1, 1, [bytes(64)], now=3.0)


@pytest.mark.parametrize(
    ("answer", "acknowledged", "range_s"),
    [(b"#R001T03200\r\n", (1,), 0.1), (b"#TO\r\n", (), None), (b"#R002T03200\r\n", (), None), (b"", (), None)],
)
def test_acknowledged_packet(
    driver: NanoModem, answer: bytes, acknowledged: tuple[int, ...], range_s: float | None
) -> None:
    driver.send_packet(1, 1, [b"hi"], ack=True, now=1.0)
    assert take(driver) == b"$M00103\x03hi"
    driver.receive(b"$M00103\r\n", 1.0)
    events = driver.poll(1.5) + driver.receive(answer, 2.0)
    events += driver.poll(1.0 + airtime_s(3) + GUARD_S + ANSWER_LIMIT_S)
    [sent] = [event for event in events if isinstance(event, PacketSent)]
    assert sent.acknowledged == acknowledged
    ranges = [event.travel_s for event in events if isinstance(event, RangeMeasured)]
    assert ranges == ([] if range_s is None else [pytest.approx(range_s)])


@pytest.mark.parametrize(("answer", "done"), [(b"#R001T00640\r\n", True), (b"#TO\r\n", False), (b"", False)])
def test_ping(driver: NanoModem, answer: bytes, done: bool) -> None:
    number = driver.ping(1, now=1.0)
    assert take(driver) == b"$P001"
    events = driver.receive(b"$P001\r\n", 1.0) + driver.receive(answer, 1.5) + driver.poll(20.0)
    if done:
        assert RangeMeasured(1, 3, 0.02) in events
        assert RequestDone(number, "ping", 1) in events
    else:
        assert RequestFailed(number, "ping", 1, "no answer") in events
        assert not [event for event in events if isinstance(event, RangeMeasured)]
    assert driver.queued == 0


def test_pings_and_packets_share_the_limited_queue() -> None:
    driver = NanoModem(ModemSettings(3))
    numbers = [driver.ping(1, now=0.0) for _ in range(20)]
    events = driver.poll(0.0) + driver.poll(1000.0)
    assert sorted(event.request_id for event in events if isinstance(event, RequestFailed)) == numbers


def test_refused_and_unconfirmed_packets_fail(driver: NanoModem) -> None:
    driver.send_packet(1, 1, [b"a"], now=1.0)
    error, failed = driver.receive(b"E\r\n", 1.1)
    assert error == ModemError("E")
    assert isinstance(failed, PacketFailed)
    assert not failed.maybe_sent
    take(driver)
    driver.send_packet(1, 1, [b"b"], now=2.0)
    assert driver.receive(b"$B64\r\n", 2.1) == [], "the confirmation of another command"
    [failed] = driver.poll(7.0)
    assert isinstance(failed, PacketFailed)
    assert failed.maybe_sent
    assert take(driver) == b"$B02\x01b$?", "the modem is asked whether it answers"


def test_lost_port_fails_the_packet_in_progress_and_keeps_the_queue(driver: NanoModem) -> None:
    driver.send_packet(1, 1, [b"a"], now=1.0)
    driver.send_packet(1, 1, [b"b"], now=1.0)
    driver.receive(b"$B02\r\n", 1.1)
    driver.port_lost(1.2)
    assert kinds(driver.poll(1.2)) == ["TransmissionEnded", "PacketFailed"]
    assert driver.queued == 1
    driver.port_opened(2.0)
    driver.receive(b"#A003\r\n", 2.0)
    assert take(driver).endswith(b"$?$B02\x01b")


def test_frames_of_broadcasts_and_unicasts(driver: NanoModem) -> None:
    frame, packet = driver.receive(b"#B00105\x02data\r\n", 5.0)
    assert frame == FrameReceived(1, 2, False, 1, b"data", 5.0, 1, None)
    assert isinstance(packet, PacketReceived)
    assert packet.complete
    assert driver.receive(b"#U05\x01data\r\n", 6.0)[0] == FrameReceived(1, 3, True, 1, b"data", 6.0, 1, None)


def test_incomplete_message_is_given_up_after_a_pause(driver: NanoModem) -> None:
    assert driver.receive(b"#B00120half", 5.0) == []
    assert driver.next_wakeup() == 5.0 + PAUSE_S
    [rejected] = driver.poll(5.0 + PAUSE_S)
    assert isinstance(rejected, SentenceRejected)
    assert kinds(driver.receive(b"#B00105\x02data\r\n", 7.0)) == ["FrameReceived", "PacketReceived"]


def test_modem_that_was_replaced_is_configured_again(driver: NanoModem) -> None:
    assert driver.next_wakeup() == CHECK_INTERVAL_S
    driver.poll(CHECK_INTERVAL_S)
    assert take(driver) == b"$?"
    [rebooted] = driver.receive(b"#A255V21941\r\n", 60.1)
    assert isinstance(rebooted, ModemRebooted)
    assert not driver.ready
    assert take(driver) == b"$A003"
    assert driver.receive(b"#A003\r\n", 60.2) == [ModemReady(3, None)]
