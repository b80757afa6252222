"""The S2C driver: its parser, its dialogue with the modem, and the commands of the emulated modem."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import FrameError, SentenceError
from sonarpost.extensions.s2c.driver import S2cModem
from sonarpost.extensions.s2c.emulated import EmulatedS2c
from sonarpost.extensions.s2c.messages import (
    MAX_DATA_BYTES,
    MAX_TEXT_BYTES,
    DeliveryReport,
    Ignored,
    RawMessage,
    ReceptionEnd,
    ReceptionStart,
    S2cData,
    S2cMessageAssembler,
    S2cReply,
    SendEnd,
    SendStart,
    UsblPosition,
    parse,
    parse_travel_time_s,
)
from sonarpost.extensions.s2c.rates import CAPABILITIES
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig
from sonarpost.modem.interface import (
    FrameReceived,
    ModemEvent,
    ModemReady,
    ModemUnresponsive,
    PacketFailed,
    PacketReceived,
    PacketSent,
    RangeMeasured,
    RequestDone,
    RequestFailed,
    SentenceRejected,
    SettingUnconfirmed,
)
from sonarpost.modem.registry import ModemSettings

# An exchange of a USBL modem, quoted by a public client of such modems (docs/reference/modem-s2c.md).
RECORDED = (
    b"+++AT*SENDIM:2:OK\r\n"
    b"+++AT:23:SENDSTART,3,im,182272,0\r\n"
    b"+++AT:30:SENDEND,3,im,1853167139,182272\r\n"
    b"+++AT:9:RECVSTART\r\n"
    b"+++AT:32:RECVEND,1853461060,139376,-36,77\r\n"
    b"+++AT:13:DELIVEREDIM,3\r\n"
    b"+++AT:124:USBLLONG,10446.991981,10446.534643,3,-0.0604,-1.0888,-0.5851,-0.4233,-1.0020,-0.5901,"
    b"0.0063,0.0269,-0.3295,825,-36,77,1.2375\r\n"
    b"+++AT:99:USBLPHYD,10446.992626,10446.534642,3,0,-39278,-10591,16777215,-12608,-27941,23818,16777215,16777215\r\n"
)
PARSED = [
    S2cReply("*SENDIM", "OK"),
    SendStart(3, "im", 0.182272),
    SendEnd(3, "im", 0.182272),
    ReceptionStart(),
    ReceptionEnd(failed=False),
    DeliveryReport("DELIVERED", "IM", 3),
    UsblPosition(3, -0.4233, -1.0020, -0.5901, 0.000825, 1.2375),
    Ignored("USBLPHYD"),
]
HOSTILE_DATA = b"\r\nDELIVEREDIM,3\r\n+++AT:13:DELIVEREDIM,3\r\n,\x00\xff"


def parsed(items: list[RawMessage | SentenceError]) -> list[object]:
    return [item if isinstance(item, SentenceError) else parse(item) for item in items]


def framed(text: bytes, command: bytes = b"") -> bytes:
    return b"+++AT%b:%d:%b\r\n" % (command, len(text), text)


def test_recorded_exchange_is_parsed_whole_byte_by_byte_and_with_junk() -> None:
    assert parsed(S2cMessageAssembler().feed(RECORDED)) == PARSED
    assembler = S2cMessageAssembler()
    assert parsed([item for byte in RECORDED for item in assembler.feed(bytes([byte]))]) == PARSED
    assembler = S2cMessageAssembler()
    junk = parsed(assembler.feed(b"\x00\xff+++ATjunk" + RECORDED + b"+++AT:9:RECV"))
    assert [item for item in junk if not isinstance(item, SentenceError)] == PARSED
    assert isinstance(junk[0], SentenceError)
    assert assembler.incomplete


@pytest.mark.parametrize("is_escaped", [True, False])
@pytest.mark.parametrize(
    ("head", "kind", "ack"),
    [
        (b"RECVIM,%d,3,1,ack,182272,-36,177,-0.1250,", "IM", True),
        (b"RECVIM,p0,%d,3,1,noack,182272,-36,177,-0.1250,", "IM", False),
        (b"RECVIMS,%d,3,1,52345678,182272,-36,177,-0.1250,", "IMS", False),
        (b"RECVPBM,%d,3,1,182272,-36,177,-0.1250,", "PBM", False),
        (b"RECV,%d,3,1,6900,-36,177,11000,-0.1250,", "", True),
    ],
)
def test_length_delimits_received_data(head: bytes, kind: str, ack: bool, is_escaped: bool) -> None:
    message = head % len(HOSTILE_DATA) + HOSTILE_DATA
    stream = framed(message) * 2 if is_escaped else (message + b"\r\n") * 2
    expected = [S2cData(kind, 3, 1, ack, -36.0, 177, -0.125, HOSTILE_DATA)] * 2
    assert parsed(S2cMessageAssembler().feed(stream)) == expected
    assembler = S2cMessageAssembler()
    assert parsed([item for byte in stream for item in assembler.feed(bytes([byte]))]) == expected


@pytest.mark.parametrize(
    "text",
    [
        b"RECVIM,4,3,1,ack,182272,-36,177,0.0,abc",
        b"RECVIM,4,3,1,ack,182272,-36,177,abcd",
        b"RECVIM,1,256,1,ack,182272,-36,177,0.0,a",
        b"RECVIM,1,-3,1,ack,182272,-36,177,0.0,a",
        b"RECVIM,1,3,1,ack,182272,nan,177,0.0,a",
        b"RECVIM,1,3,1,ack,182272,-36,1e9,0.0,a",
        b"RECVIM,1,3,1,ack,182272,-36,9999999,0.0,a",
        b"SENDEND,3,im,1,99999999999999999999",
        b"SENDSTART,3,im,-1,0",
        b"SENDEND,3",
        b"DELIVEREDIM",
        b"DELIVEREDIM,3,4",
        b"USBLLONG,1,2",
        b"RECVXYZ",
        b"\xff",
        b"",
    ],
)
def test_wrong_notification_is_refused(text: bytes) -> None:
    with pytest.raises(SentenceError):
        parse(RawMessage("", text))


@pytest.mark.parametrize(
    "broken",
    [
        b"+++AT:9:RECVSTA",  # cut
        b"+++AT:8:RECVSTART\r\n",  # wrong lengths
        b"+++AT:11:RECVSTART\r\n",
        b"+++AT:9999:RECVSTART\r\n",
        b"+++AT:99999999:RECVSTART\r\n",
        b"+++AT" + b"x" * 100 + b":2:OK\r\n",
        b"+++AT\r\n",
        b"x" * (MAX_TEXT_BYTES + 1),
        b"RECVIM,%d,3,1,ack,1,1,1,1," % (MAX_DATA_BYTES + 1),
        b"RECVIM,4," + b"1" * 400,
        b"RECVIM,4,3,1\r\n",
    ],
)
def test_next_message_is_found_after_a_broken_one(broken: bytes) -> None:
    assembler = S2cMessageAssembler()
    items = assembler.feed(broken + framed(b"DELIVEREDIM,3") * 3) + assembler.abandon()
    assert any(item == RawMessage("", b"DELIVEREDIM,3") for item in items)
    assert not assembler.incomplete


@given(st.lists(st.one_of(st.binary(max_size=80), st.sampled_from([RECORDED, b"+++AT:", b"RECVIM,4,", b"\r\n", b"+"]))))
def test_parser_accepts_any_bytes(parts: list[bytes]) -> None:
    assembler = S2cMessageAssembler()
    for item in [item for part in parts for item in assembler.feed(part)] + assembler.abandon():
        if isinstance(item, RawMessage):
            with suppress(SentenceError):
                parse(item)
    assert not assembler.incomplete


@given(st.binary(max_size=64), st.integers(1, 5))
def test_any_data_is_received_in_any_parts(data: bytes, size: int) -> None:
    stream = framed(b"RECVIM,%d,3,1,ack,182272,-36,177,0.0000,%b" % (len(data), data))
    assembler = S2cMessageAssembler()
    parts = [stream[n : n + size] for n in range(0, len(stream), size)]
    assert parsed([item for part in parts for item in assembler.feed(part)]) == [
        S2cData("IM", 3, 1, True, -36.0, 177, 0.0, data)
    ]


@pytest.mark.parametrize(
    ("text", "travel_s"), [("825", 0.000825), ("0", None), ("-1", None), ("9" * 30, None), ("", None)]
)
def test_travel_time_is_limited(text: str, travel_s: float | None) -> None:
    assert parse_travel_time_s(text) == travel_s


ANSWERS = {b"?AL": b"1", b"@CTRL": b"ERROR WRONG FORMAT", b"I0": b"1.9", b"@ZX1": b"OK", b"!AL1": b"OK"}


def answer(modem: S2cModem, text: bytes, now: float = 1.0) -> list[ModemEvent]:
    """Answer the command that the driver has just sent."""
    command = modem.bytes_to_send().removeprefix(b"+++AT").strip().partition(b",")[0]
    return modem.receive(framed(text, command.rstrip(b"0123456789") if command != b"I0" else command), now)


def ready_modem() -> S2cModem:
    modem = S2cModem(ModemSettings(1))
    modem.port_opened(0.0)
    for command in (b"?AL", b"@CTRL", b"I0", b"@ZX1", b"!AL1"):
        assert answer(modem, ANSWERS[command]) == []
    [event] = answer(modem, b"1")
    assert event == ModemReady(1, "1.9")
    assert modem.ready
    return modem


def test_message_is_sent_and_acknowledged() -> None:
    modem = ready_modem()
    number = modem.send_packet(3, 0, [HOSTILE_DATA], ack=True, now=2.0)
    assert modem.bytes_to_send() == b"+++AT*SENDIM,%d,3,ack,%b\n" % (len(HOSTILE_DATA), HOSTILE_DATA)
    assert modem.receive(framed(b"DELIVEREDIM,3"), 2.0) == [], "a report of an older message"
    modem.receive(framed(b"OK", b"*SENDIM"), 2.0)
    modem.receive(framed(b"SENDSTART,3,im,182272,0") + framed(b"SENDEND,3,im,1853167139,182272"), 2.2)
    assert modem.receive(framed(b"DELIVEREDIM,4"), 2.4) == []
    [sent] = modem.receive(framed(b"DELIVEREDIM,3"), 2.5)
    assert isinstance(sent, PacketSent)
    assert (sent.packet_id, sent.acknowledged, sent.end_reported) == (number, (1,), True)


@pytest.mark.parametrize("report", [b"FAILEDIM,3", b""])
def test_unacknowledged_message_is_sent_without_acknowledgement(report: bytes) -> None:
    modem = ready_modem()
    modem.send_packet(3, 0, [b"a"], ack=True, now=2.0)
    answer(modem, b"OK", 2.0)
    events = modem.receive(framed(report), 5.0) if report else modem.poll(60.0)
    [sent] = [event for event in events if isinstance(event, PacketSent)]
    assert sent.acknowledged == ()


def test_end_of_an_acknowledgement_does_not_end_a_message() -> None:
    modem = ready_modem()
    modem.send_packet(3, 0, [b"a"], now=2.0)
    modem.receive(framed(b"OK", b"*SENDIM"), 2.0)
    assert not [e for e in modem.receive(framed(b"SENDEND,3,ack,1,139376"), 2.1) if isinstance(e, PacketSent)]
    assert [e for e in modem.receive(framed(b"SENDEND,3,im,1,182272"), 2.3) if isinstance(e, PacketSent)]


@pytest.mark.parametrize("refusal", [b"BUSY DELIVERING MESSAGE", b"ERROR OUT OF RANGE"])
def test_refused_message_is_sent_again_three_times(refusal: bytes) -> None:
    modem = ready_modem()
    number = modem.send_packet(3, 0, [b"a"], now=2.0)
    events: list[ModemEvent] = []
    for attempt in range(3):
        events += answer(modem, refusal, 2.0 + attempt)
        events += modem.poll(3.0 + attempt)
    [failed] = [event for event in events if isinstance(event, PacketFailed)]
    assert (failed.packet_id, failed.maybe_sent) == (number, False)
    assert modem.bytes_to_send() == b""


def test_canceled_message_is_sent_again() -> None:
    modem = ready_modem()
    modem.send_packet(3, 0, [b"a"], now=2.0)
    answer(modem, b"OK", 2.0)
    assert modem.receive(framed(b"CANCELEDIM,3"), 2.1) == []
    modem.poll(3.2)
    assert modem.bytes_to_send() == b"+++AT*SENDIM,1,3,noack,a\n"


def test_missing_answer_configures_the_modem_again() -> None:
    modem = ready_modem()
    modem.send_packet(3, 0, [b"a"], now=2.0)
    modem.bytes_to_send()
    [failed] = modem.poll(7.0)
    assert isinstance(failed, PacketFailed)
    assert failed.maybe_sent
    assert not modem.ready
    assert modem.bytes_to_send() == b"+++AT?AL\n"
    assert modem.receive(framed(b"OK", b"*SENDIM"), 7.1) == [], "the late answer"


def test_line_end_is_found_and_silence_is_reported_once() -> None:
    modem = S2cModem(ModemSettings(1))
    modem.port_opened(0.0)
    ends, events, now = [modem.bytes_to_send()[-1:]], [], 0.0
    for _ in range(6):
        now = modem.next_wakeup() or 0.0
        events += modem.poll(now)
        ends.append(modem.bytes_to_send()[-1:])
    assert ends[:4] == [b"\n", b"\r", b"\n", b"\r"]
    assert [type(event) for event in events] == [ModemUnresponsive]
    modem.receive(framed(b"1", b"?AL"), now)
    assert modem.bytes_to_send() == b"+++AT@CTRL" + ends[-1]


def test_modem_with_another_address_is_not_ready() -> None:
    modem = S2cModem(ModemSettings(1))
    modem.port_opened(0.0)
    for text in (b"7", b"OK", b"1.9", b"ERROR WRONG FORMAT"):
        events = answer(modem, text)
    assert events == [SettingUnconfirmed("AT@ZX1")]
    answer(modem, b"OK")
    assert answer(modem, b"7") == []
    assert not modem.ready


def burst_modem(*frames: bytes, ack: bool = False) -> tuple[S2cModem, int]:
    """Return a driver with accepted burst data, and the number of the packet."""
    modem = ready_modem()
    number = modem.send_packet(3, 1, frames, ack=ack, now=2.0)
    answer(modem, b"OK", 2.0)
    return modem, number


def test_frames_of_burst_data_are_joined_and_divided_again() -> None:
    modem = ready_modem()
    modem.send_packet(3, 1, [HOSTILE_DATA, b"ack,b"], now=2.0)
    data = HOSTILE_DATA.ljust(64, b"\0") + b"ack,b"
    assert modem.bytes_to_send() == b"+++AT*SEND,69,3,%b\n" % data
    *frames, packet = modem.receive(framed(b"RECV,69,3,1,6500,-40,150,66667,0.0000," + data), 3.0)
    assert [frame.data for frame in frames if isinstance(frame, FrameReceived)] == [data[:64], b"ack,b"]
    assert isinstance(packet, PacketReceived)
    assert (packet.frames, packet.rate, packet.complete) == (tuple(frames), 1, True)


@pytest.mark.parametrize(
    ("ack", "report", "acknowledged"), [(True, b"DELIVERED", (1, 2)), (False, b"DELIVERED", ()), (True, b"FAILED", ())]
)
def test_report_ends_burst_data(ack: bool, report: bytes, acknowledged: tuple[int, ...]) -> None:
    modem, number = burst_modem(b"a", b"b", ack=ack)
    for other in (b"DELIVEREDIM,3", b"DELIVERED,1,4", b"SENDEND,3,im,1,182272"):
        events = modem.receive(framed(other), 2.5)
        assert not [event for event in events if isinstance(event, PacketSent)]
    [sent] = modem.receive(framed(report + b",1,3"), 3.0)
    assert isinstance(sent, PacketSent)
    assert (sent.packet_id, sent.acknowledged, sent.end_reported) == (number, acknowledged, True)
    assert modem.ready


def test_burst_data_without_report_is_dropped_by_the_modem() -> None:
    modem, number = burst_modem(b"a")
    assert modem.poll(61.9) == []
    [sent] = modem.poll(62.0)
    assert isinstance(sent, PacketSent)
    assert (sent.packet_id, sent.end_reported) == (number, False)
    assert modem.bytes_to_send() == b"+++AT?AL\n"
    modem.receive(framed(b"1", b"?AL"), 62.0)
    assert modem.bytes_to_send() == b"+++ATZ1\n"


def test_answer_to_burst_data_is_none_to_an_instant_message() -> None:
    modem = ready_modem()
    modem.send_packet(3, 0, [b"a"], now=2.0)
    modem.receive(framed(b"OK", b"*SEND") + framed(b"SENDEND,3,im,1,182272"), 2.0)
    assert modem.queued == 1


def test_burst_data_has_no_broadcast() -> None:
    with pytest.raises(FrameError, match="destination"):
        ready_modem().send_packet(255, 1, [b"a"], now=2.0)
    assert ready_modem().send_packet(255, 0, [b"a"], now=2.0) > 0


def test_text_between_messages_of_data_mode_is_refused() -> None:
    modem = ready_modem()
    modem.send_packet(3, 0, [b"a"], ack=True, now=2.0)
    events = modem.receive(b"OK\r\nDELIVEREDIM,3\r\n", 2.0)
    assert [type(event) for event in events] == [SentenceRejected, SentenceRejected]
    assert modem.queued == 1


def test_reception_delays_a_message_for_a_limited_time() -> None:
    modem = ready_modem()
    modem.receive(framed(b"RECVSTART"), 2.0)
    assert modem.receiving
    modem.send_packet(3, 0, [b"a"], now=2.0)
    assert modem.bytes_to_send() == b""
    for second in range(3, 32):
        modem.receive(framed(b"RECVSTART"), float(second))
        assert modem.bytes_to_send() == b""
    modem.receive(framed(b"RECVSTART"), 33.0)
    assert modem.bytes_to_send().startswith(b"+++AT*SENDIM")


def test_failed_reception_is_counted_and_position_is_reported() -> None:
    modem = ready_modem()
    [packet] = modem.receive(framed(b"RECVSTART") + framed(b"RECVFAILED,0.0200,-50,60"), 2.0)
    assert isinstance(packet, PacketReceived)
    assert (packet.bad_frames, packet.complete) == (1, False)
    usbl = b"USBLLONG,1.0,0.5,3,-0.06,-1.08,-0.58,-0.42,-1.00,-0.59,0.006,0.026,-0.32,825,-36,77,1.2375"
    assert modem.receive(framed(usbl), 3.0) == [UsblPosition(3, -0.42, -1.0, -0.59, 0.000825, 1.2375)]


def test_incomplete_message_is_given_up_after_a_pause() -> None:
    modem = ready_modem()
    assert modem.receive(b"+++AT:4000:x" + framed(b"RECVIM,1,3,1,noack,1,-36,177,0.0,a"), 2.0) == []
    assert modem.next_wakeup() == pytest.approx(4.0)
    events = modem.poll(4.0)
    assert [type(event) for event in events] == [SentenceRejected, FrameReceived, PacketReceived]


def test_silent_modem_is_checked() -> None:
    modem = ready_modem()
    assert modem.next_wakeup() == pytest.approx(61.0)
    assert modem.poll(61.0) == []
    assert answer(modem, b"OK", 61.0) == []
    assert answer(modem, b"1", 61.0) == []
    assert modem.ready
    modem.poll(122.0)
    answer(modem, b"OK", 122.0)
    answer(modem, b"9", 122.0)
    assert not modem.ready, "the modem has another address now"


def test_ping_measures_the_travel_time() -> None:
    modem = ready_modem()
    number = modem.ping(3, 2.0)
    assert modem.bytes_to_send() == b"+++AT*SENDIM,1,3,ack,\0\n"
    modem.receive(framed(b"OK", b"*SENDIM"), 2.0)
    assert modem.receive(framed(b"DELIVEREDIM,3"), 3.0) == []
    events = answer(modem, b"266667", 3.0)
    assert events == [RangeMeasured(3, 1, 0.266667), RequestDone(number, "ping", 3)]
    assert modem.receive(framed(b"RECVIM,1,3,1,ack,1,-36,177,0.0,\0"), 4.0) == [], "a ping is no frame"


def test_ping_without_an_answer_fails() -> None:
    modem = ready_modem()
    number = modem.ping(3, 2.0)
    answer(modem, b"OK", 2.0)
    [event] = modem.receive(framed(b"FAILEDIM,3"), 8.0)
    assert event == RequestFailed(number, "ping", 3, "the other modem has not answered")
    modem.port_lost(9.0)
    number = modem.ping(3, 9.0)
    [event] = modem.poll(9.0 + 3600.0)
    assert isinstance(event, RequestFailed)
    assert event.request_id == number


@pytest.mark.parametrize("address", [0, 255])
def test_destination_and_length_are_checked(address: int) -> None:
    with pytest.raises(FrameError):
        ready_modem().ping(address, 2.0)
    with pytest.raises(FrameError, match="length of frame 1"):
        ready_modem().send_packet(3, 0, [bytes(65)], now=2.0)
    assert max(rate.frame_bytes for rate in CAPABILITIES.rates.values()) == 64


def test_emulated_modem_limits_its_input_and_knows_both_modes() -> None:
    modem = EmulatedS2c(EmulatedModemConfig(4, driver="s2c"))

    def say(data: bytes) -> bytes:
        modem.receive(data, 0.0)
        return b"".join(output.data for output in modem.take_outputs())

    assert say(b"AT?AL\n") == b"", "burst data of data mode"
    assert say(b"+++AT?AL\r\n") == b"+++AT?AL:1:4\r\n"
    assert say(b"+++ATC\n") == b"+++ATC:2:OK\r\n"
    assert say(b"AT?AL\nAT!AL5\nAT?AL\nAT?S\n") == b"4\r\nOK\r\n5\r\nINITIATION LISTEN\r\n"
    assert say(b"ATX\n") == b"ERROR WRONG FORMAT\r\n"
    assert say(b"AT*SENDIM,65,3,ack," + bytes(65) + b"\n") == b"ERROR OUT OF RANGE\r\n"
    assert say(b"AT*SENDIM,2,3,ack,abc\n") == b"ERROR WRONG FORMAT\r\n"
    assert say(b"AT*SENDIM,p0,2,3,ack,\r\n\n") == b"OK\r\n"
    assert say(b"AT*SENDIM,1,3,ack,a\n") == b"BUSY DELIVERING MESSAGE\r\n"
    assert say(b"AT*SENDIM,9999,3,ack,a" + b"x" * 5000) == b"ERROR WRONG FORMAT\r\n"
    assert say(b"AT*SEND,1025,3," + bytes(1025) + b"\n") == b"ERROR WRONG FORMAT\r\n"
    assert say(b"AT*SEND,1,255,a\n") == b"ERROR OUT OF RANGE\r\n"
    assert say(b"AT*SEND,p0,6,3,ack,\r\n\nAT?PC\n") == b"OK\r\n1\r\n"
    assert say(b"AT*SEND,1,3,a\n" * 16) == b"OK\r\n" * 15 + b"BUSY DELIVERING MESSAGE\r\n"
    assert say(b"ATZ1\nAT*SEND,1,3,a\n") == b"OK\r\nOK\r\n"
    assert say(b"x" * 5000) == b""
    assert say(b"ATO\n") == b"OK\r\n"
    assert say(b"AT?AL\n") == b"", "data mode again"
