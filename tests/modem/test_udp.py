"""The UDP driver: its datagrams, acknowledgements and pace."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import SentenceError
from sonarpost.modem.interface import (
    FrameReceived,
    ModemEvent,
    ModemReady,
    PacketReceived,
    PacketSent,
    SentenceRejected,
)
from sonarpost.modem.registry import ModemSettings
from sonarpost.modem.udp import RATES, UdpModem
from sonarpost.modem.udp.datagram import MAX_DATAGRAM_BYTES, Datagram, DatagramAssembler, DatagramKind, parse

byte = st.integers(0, 255)
datagrams = st.builds(
    Datagram,
    st.sampled_from(DatagramKind),
    byte,
    byte,
    byte,
    st.integers(0, 65535),
    st.lists(st.none() | st.binary(max_size=256), max_size=8).map(tuple),
)

GOLDEN = Datagram(DatagramKind.DATA_WITH_ACK, 3, 1, 1, 258, (b"snippet", None, b""))
GOLDEN_HEX = "53504d31001e020301010102030007736e6970706574ffff0000efaf6d75"


def test_golden_datagram() -> None:
    assert GOLDEN.pack().hex() == GOLDEN_HEX
    assert parse(bytes.fromhex(GOLDEN_HEX)) == GOLDEN


@given(datagrams)
def test_round_trip_whole_and_byte_by_byte(datagram: Datagram) -> None:
    packed = datagram.pack()
    assert parse(packed) == datagram
    assembler = DatagramAssembler()
    found = [item for index in range(len(packed)) for item in assembler.feed(packed[index : index + 1])]
    assert found == [datagram]


@given(st.binary(max_size=300), datagrams)
def test_junk_is_an_error_and_the_next_datagram_is_read(junk: bytes, datagram: Datagram) -> None:
    assembler = DatagramAssembler()
    found = assembler.feed(junk.replace(b"SPM1", b"") + datagram.pack())
    assert found[-1] == datagram
    assert all(isinstance(item, SentenceError) for item in found[:-1])


@given(datagrams, st.data())
def test_damaged_datagram_is_refused(datagram: Datagram, data: st.DataObject) -> None:
    packed = bytearray(datagram.pack())
    packed[data.draw(st.integers(0, len(packed) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(SentenceError):
        parse(bytes(packed))


def test_length_is_limited() -> None:
    assembler = DatagramAssembler()
    [error] = assembler.feed(b"SPM1" + (MAX_DATAGRAM_BYTES + 1).to_bytes(2, "big"))
    assert isinstance(error, SentenceError)


def pair() -> tuple[UdpModem, UdpModem]:
    modems = UdpModem(ModemSettings(1)), UdpModem(ModemSettings(2))
    for modem in modems:
        modem.port_opened(0.0)
        assert [type(event) for event in modem.poll(0.0)] == [ModemReady]
    return modems


def exchange(one: UdpModem, other: UdpModem, now: float) -> list[ModemEvent]:
    events: list[ModemEvent] = []
    while data := one.bytes_to_send():
        events += other.receive(data, now)
    return events


def test_packet_arrives_and_is_acknowledged() -> None:
    one, two = pair()
    number = one.send_packet(2, 1, [b"a", b"", b"c"], ack=True, now=0.0)
    events = exchange(one, two, 0.1)
    assert [e.data for e in events if isinstance(e, FrameReceived)] == [b"a", b"", b"c"]
    [packet] = [e for e in events if isinstance(e, PacketReceived)]
    assert packet.complete
    assert not [e for e in exchange(two, one, 0.2) if isinstance(e, PacketReceived)]
    assert not [e for e in one.poll(RATES[1].airtime_s - 0.01) if isinstance(e, PacketSent)], "air time"
    [sent] = [e for e in one.poll(RATES[1].airtime_s) if isinstance(e, PacketSent)]
    assert (sent.packet_id, sent.acknowledged) == (number, (1, 2, 3))


def test_wait_for_an_acknowledgement_is_limited() -> None:
    one, _ = pair()
    one.send_packet(2, 1, [b"a"], ack=True, now=0.0)
    one.poll(1.0)
    assert one.next_wakeup() == pytest.approx(RATES[1].airtime_s + 5.0)
    [sent] = one.poll(6.0)
    assert isinstance(sent, PacketSent)
    assert sent.acknowledged == ()


def test_own_and_repeated_datagrams_are_ignored() -> None:
    one, two = pair()
    one.send_packet(255, 0, [b"a"], now=0.0)
    data = one.bytes_to_send()
    assert [type(e).__name__ for e in one.receive(data, 0.0)] == ["TransmissionStarted"]
    assert len(two.receive(data, 0.1)) == 2
    assert two.receive(data, 0.2) == []
    restarted = UdpModem(ModemSettings(1))
    restarted.port_opened(0.0)
    restarted.send_packet(255, 0, [b"b"], now=0.0)
    assert len(exchange(restarted, two, 0.3)) == 2, "the same number, another packet"


def test_lost_frames_are_counted() -> None:
    _, two = pair()
    events = two.receive(Datagram(DatagramKind.DATA, 1, 2, 1, 7, (b"a", None, b"c")).pack(), 1.0)
    [packet] = [e for e in events if isinstance(e, PacketReceived)]
    assert (packet.bad_frames, packet.nframes, packet.complete) == (1, 3, False)
    assert [frame.frame_number for frame in packet.frames] == [1, 3]


@given(st.lists(st.binary(max_size=300) | st.integers(1, 60), max_size=5), datagrams, st.floats(0.0, 10.0))
def test_datagram_neither_completes_nor_damages_another(
    junk: list[bytes | int], datagram: Datagram, pause_s: float
) -> None:
    """Junk, and beginnings of a valid datagram, before and after each datagram."""
    modem = UdpModem(ModemSettings(1))
    modem.port_opened(0.0)
    modem.poll(0.0)
    datagram = dataclasses.replace(datagram, kind=DatagramKind.DATA, source=2)
    packed, now = datagram.pack(), 0.0
    wrong = [part if isinstance(part, bytes) else packed[: min(part, len(packed) - 1)] for part in junk]
    events: list[ModemEvent] = []
    for data in (*wrong, b"SPM1\x10\x00", packed, *wrong):
        events += modem.receive(data, now)
        now += pause_s
    assert sum(isinstance(event, PacketReceived) for event in events) == 1
    assert sum(isinstance(event, SentenceRejected) for event in events) == 2 * len(wrong) + 1


def test_two_halves_are_no_datagram() -> None:
    modem = UdpModem(ModemSettings(1))
    modem.port_opened(0.0)
    modem.poll(0.0)
    packed = GOLDEN.pack()
    events = [event for half in (packed[:10], packed[10:]) for event in modem.receive(half, 0.0)]
    assert [type(event) for event in events] == [SentenceRejected, SentenceRejected]


def test_repeated_datagram_is_received_once_and_other_content_of_its_number_too() -> None:
    modem = UdpModem(ModemSettings(1))
    modem.port_opened(0.0)
    modem.poll(0.0)
    frames: list[tuple[bytes, ...]] = [(b"ab", b"c"), (b"a", b"bc"), (b"ab", b"c")]
    received = []
    for content in frames:
        for event in modem.receive(Datagram(DatagramKind.DATA, 2, 255, 1, 7, content).pack(), 0.0):
            if isinstance(event, PacketReceived):
                received.append(tuple(frame.data for frame in event.frames))
    assert received == frames[:2]
