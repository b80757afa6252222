from collections.abc import Callable

import pytest
from builders.fake_modem import FakeModem
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.modem.interface import (
    FrameReceived,
    ModemReady,
    ModemRebooted,
    PacketReceived,
    PacketSent,
    SentenceRejected,
)
from sonarpost.modem.micromodem import MicroModem, MicroModemConfig

CONFIG = MicroModemConfig(address=1)
FRAMES = (b"first frame", b"second")


def ready() -> FakeModem:
    modem = FakeModem(MicroModem(CONFIG))
    modem.driver.port_opened(0.0)
    modem.run(5.0)
    assert modem.events == [ModemReady(1, None)]
    modem.events.clear()
    modem.received.clear()
    return modem


def cst(modem: FakeModem, rate: int = 4, nframes: int = 2, nbad: int = 0, mode: int = 0, packet_type: int = 3) -> None:
    fields = f"8,{mode},20250606230123.348554,06,32767,45,0102,0123,07,00,00,00,00,{rate},003,001,0,{packet_type}"
    modem.send("CACST", *f"{fields},{nframes},{nbad},150,26.0,9.48,-100,-6.48,-01,0.01,51,25000,5000".split(","))


def packet_steps(modem: FakeModem, frames: tuple[bytes, ...] = FRAMES) -> list[Callable[[], None]]:
    return [
        lambda: modem.send("CARXP", 1),
        lambda: modem.send("CACYC", 0, 3, 1, 4, 0, len(frames)),
        *[lambda n=n, f=f: modem.send("CARXD", 3, 1, 0, n, f.hex().upper()) for n, f in enumerate(frames, 1)],
        lambda: cst(modem),
    ]


def frames_of(modem: FakeModem) -> list[bytes]:
    return [event.data for event in modem.events_of(FrameReceived)]


def test_complete_packet() -> None:
    modem = ready()
    for step in packet_steps(modem)[:-1]:
        step()
        assert modem.events == [], "frames wait for the statistics"
        assert modem.driver.receiving
    cst(modem)
    assert not modem.driver.receiving
    first, second, packet = modem.events
    assert (first.src, first.dest, first.ack, first.frame_number, first.data) == (3, 1, False, 1, b"first frame")
    assert (first.rate, first.received_s, second.frame_number, second.data) == (4, 5.0, 2, b"second")
    assert first.statistics is packet.statistics
    assert (first.statistics.snr_out_db, first.statistics.spl_db) == (9.48, 123)
    assert packet.frames == (first, second)
    assert (packet.src, packet.dest, packet.rate, packet.nframes, packet.bad_frames) == (3, 1, 4, 2, 0)
    assert packet.complete


@pytest.mark.parametrize("lost", range(5), ids=["CARXP", "CACYC", "CARXD 1", "CARXD 2", "CACST"])
def test_lost_sentence_loses_at_most_its_own_frame(lost: int) -> None:
    modem = ready()
    for number, step in enumerate(packet_steps(modem)):
        if number != lost:
            step()
    modem.run(30.0)
    assert frames_of(modem) == [f for number, f in enumerate(FRAMES, 2) if number != lost]
    (packet,) = modem.events_of(PacketReceived)
    assert packet.complete == (lost in {0, 1})
    assert (packet.statistics is None) == (lost == 4)
    assert all(event.statistics is packet.statistics for event in modem.events_of(FrameReceived))
    assert not modem.driver.receiving


def test_frames_without_statistics_are_reported_after_the_timeout() -> None:
    modem = ready()
    for step in packet_steps(modem)[:-1]:
        step()
    modem.run(5.0 + CONFIG.on_air_limit_s(4) - 0.1)
    assert modem.events == []
    modem.run(5.0 + CONFIG.on_air_limit_s(4) + 0.1)
    assert frames_of(modem) == list(FRAMES)
    (packet,) = modem.events_of(PacketReceived)
    assert not packet.complete
    assert packet.rate == 4


@pytest.mark.parametrize("skipped", [0, 1, 2], ids=["nothing", "CARXP", "CARXP and CACYC"])
def test_next_packet_ends_a_packet_without_statistics(skipped: int) -> None:
    modem = ready()
    for step in packet_steps(modem)[:-1]:
        step()
    for step in packet_steps(modem, (b"third", b"fourth"))[skipped:]:
        step()
    assert frames_of(modem) == [*FRAMES, b"third", b"fourth"]
    first, second = modem.events_of(PacketReceived)
    assert not first.complete
    assert second.complete


def test_frame_of_another_source_and_an_announcement_start_another_packet() -> None:
    modem = ready()
    modem.send("CARXD", 3, 1, 0, 1, "AA")
    modem.send("CARXD", 4, 9, 1, 2, "BB")
    modem.send("CACYC", 0, 4, 9, 4, 1, 2)
    modem.send("CARXD", 4, 9, 1, 2, "CC")
    cst(modem)
    packets = modem.events_of(PacketReceived)
    assert [[(f.src, f.dest, f.ack, f.data) for f in packet.frames] for packet in packets] == [
        [(3, 1, False, b"\xaa")],
        [(4, 9, True, b"\xbb")],
        [(4, 9, True, b"\xcc")],
    ]
    assert not any(packet.complete for packet in packets)


@pytest.mark.parametrize(("bad_messages", "nbad"), [(1, 1), (1, 0), (0, 1)])
def test_damaged_frames_are_counted(bad_messages: int, nbad: int) -> None:
    modem = ready()
    steps = packet_steps(modem)
    for step in steps[:3]:
        step()
    for _ in range(bad_messages):
        modem.send("CAMSG", "BAD_CRC", 2)
    cst(modem, nbad=nbad, mode=1)
    (frame, packet) = modem.events
    assert frame.data == FRAMES[0]
    assert (packet.bad_frames, packet.nframes, packet.complete) == (1, 2, False)
    assert packet.statistics.mode == 1


def test_packet_without_any_good_frame() -> None:
    modem = ready()
    modem.send("CARXP", 1)
    cst(modem, nframes=2, nbad=2, mode=1)
    (packet,) = modem.events
    assert (packet.frames, packet.bad_frames, packet.src, packet.rate, packet.complete) == ((), 2, 3, 4, False)


def test_packet_with_bad_mode_is_not_complete() -> None:
    modem = ready()
    for step in packet_steps(modem)[:-1]:
        step()
    cst(modem, mode=2)
    assert not modem.events_of(PacketReceived)[0].complete


def test_packet_timeout_of_the_modem_ends_the_packet() -> None:
    modem = ready()
    for step in packet_steps(modem)[:3]:
        step()
    modem.send("CAMSG", "PACKET_TIMEOUT", 4)
    assert modem.events == []
    modem.run(5.0 + CONFIG.statistics_timeout_s + 0.1)
    assert frames_of(modem) == [FRAMES[0]]
    assert not modem.events_of(PacketReceived)[0].complete


def test_invalid_statistics_end_the_packet() -> None:
    modem = ready()
    for step in packet_steps(modem)[:-1]:
        step()
    modem.send("CACST", 8, "what", 1)
    assert frames_of(modem) == list(FRAMES)
    assert modem.events_of(PacketReceived)[0].complete
    assert modem.events_of(PacketReceived)[0].statistics is None
    assert len(modem.events_of(SentenceRejected)) == 1


def test_frame_with_invalid_fields_is_rejected_alone() -> None:
    modem = ready()
    modem.send("CARXP", 1)
    modem.send("CACYC", 0, 3, 1, 4, 0, 2)
    modem.send("CARXD", 3, 1, 0, 1, "ABC")
    modem.send("CARXD", 3, 1, 0, 2, "AB")
    cst(modem)
    assert frames_of(modem) == [b"\xab"]
    assert not modem.events_of(PacketReceived)[0].complete
    assert modem.events_of(SentenceRejected)[0].error.field == "data"


def test_rate_0_packet_has_a_header_with_its_own_statistics() -> None:
    modem = ready()
    modem.send("CARXP", 0)
    modem.send("CACYC", 0, 3, 1, 0, 0, 1)
    cst(modem, rate=0, nframes=0, packet_type=2)
    assert modem.events == []
    assert modem.driver.receiving
    modem.run(7.0)
    modem.send("CARXP", 0)
    modem.send("CARXD", 3, 1, 0, 1, "AB")
    cst(modem, rate=0, nframes=1, packet_type=1)
    (packet,) = modem.events_of(PacketReceived)
    assert packet.complete
    assert packet.rate == 0
    assert frames_of(modem) == [b"\xab"]


def test_acknowledgements_are_not_a_packet() -> None:
    modem = ready()
    modem.send("CARXP", 1)
    modem.send("CAACK", 3, 1, 1, 1)
    modem.send("CAACK", 3, 1, 2, 0)
    cst(modem, nframes=0, packet_type=4)
    assert modem.events == []
    assert not modem.driver.receiving


def test_restart_or_lost_port_reports_the_received_frames() -> None:
    for end in ("restart", "port"):
        modem = ready()
        for step in packet_steps(modem)[:3]:
            step()
        if end == "restart":
            modem.send("CAREV", "000001", "INIT", "1.2.3")
        else:
            modem.driver.port_lost(modem.now)
            modem.events += modem.driver.poll(modem.now)
        kinds = [FrameReceived, PacketReceived] + [ModemRebooted] * (end == "restart")
        assert [type(event) for event in modem.events] == kinds


def test_revision_during_a_packet_has_no_effect() -> None:
    for configured in (True, False):
        modem = ready() if configured else FakeModem(MicroModem(CONFIG))
        if not configured:
            modem.silent_kinds.add("CACFG")
            modem.driver.port_opened(0.0)
        for step in packet_steps(modem):
            modem.send("CAREV", "181807", "AUV", "2.0.27087")
            modem.send("CACFG", "X", 1)
            step()
        assert modem.events_of(PacketReceived)[0].complete


def test_no_cycle_starts_during_a_reception() -> None:
    modem = ready()
    steps = packet_steps(modem)
    steps[0]()
    modem.driver.send_packet(3, 4, [b"answer"], now=modem.now)
    for step in steps[1:-1]:
        modem.run(modem.now + 1.0)
        assert modem.received == []
        step()
    cst(modem)
    modem.run(modem.now + 6.0)
    assert [s.kind for s in modem.received] == ["CCCYC", "CCTXD"]
    assert len(modem.events_of(PacketSent)) == 1


def test_wait_for_an_announced_packet_is_bounded() -> None:
    modem = ready()
    modem.send("CARXP", 1)
    modem.driver.send_packet(3, 4, [b"answer"], now=modem.now)
    modem.run(5.0 + CONFIG.on_air_limit_s(None) - 0.1)
    assert modem.received == []
    modem.run(5.0 + CONFIG.on_air_limit_s(None) + 0.1)
    assert [s.kind for s in modem.received][:1] == ["CCCYC"]
    assert modem.events_of(PacketReceived) == [], "noise is not a packet"


@given(st.lists(st.integers(0, 6), max_size=40), st.data())
def test_every_frame_is_reported_exactly_once(script: list[int], data: st.DataObject) -> None:
    """The sentences of receptions come in any order, with any pauses."""
    modem = ready()
    given_frames: list[bytes] = []
    for step in script:
        if step == 0:
            modem.send("CARXP", 1)
        elif step == 1:
            modem.send("CACYC", 0, data.draw(st.integers(2, 4)), 1, data.draw(st.integers(0, 6)), 0, 2)
        elif step in {2, 3}:
            given_frames.append(len(given_frames).to_bytes(2, "big"))
            modem.send("CARXD", 3, 1, 0, data.draw(st.integers(1, 3)), given_frames[-1].hex())
        elif step == 4:
            modem.send("CAMSG", "BAD_CRC", 1)
        elif step == 5:
            cst(modem)
        else:
            modem.run(modem.now + data.draw(st.floats(0.1, 20.0)))
    modem.run(modem.now + 60.0)
    assert frames_of(modem) == given_frames
    assert [f.data for packet in modem.events_of(PacketReceived) for f in packet.frames] == given_frames
    assert not modem.driver.receiving


def test_slow_serial_line_does_not_split_a_packet() -> None:
    """At 19200 baud, eight full frames in hex take seconds, beyond the air time of the packet."""
    modem = ready()
    for step in packet_steps(modem)[:2]:
        step()
    modem.run(5.0 + CONFIG.on_air_limit_s(4) - 0.1)
    modem.send("CARXD", 3, 1, 0, 1, "AA")
    modem.run(modem.now + CONFIG.statistics_timeout_s - 0.1)
    modem.send("CARXD", 3, 1, 0, 2, "BB")
    modem.run(modem.now + CONFIG.statistics_timeout_s - 0.1)
    assert modem.events == []
    cst(modem)
    assert modem.events_of(PacketReceived)[0].complete


def test_single_damaged_frame_is_reported_as_a_packet() -> None:
    modem = ready()
    modem.send("CAMSG", "BAD_CRC", 1)
    modem.run(30.0)
    (packet,) = modem.events
    assert (packet.frames, packet.bad_frames, packet.nframes, packet.complete) == ((), 1, None, False)
