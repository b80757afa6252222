"""Each sentence of each exchange, in either direction, is lost, garbled, cut off or doubled once: the next packet goes.

Both sides are whole: two drivers on two emulated modems. What is spoiled may cost the exchange it belongs to, never the
one after it, never a wrong byte, and never more than a bounded time.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
from builders.two_drivers import Spoil, TwoDrivers, cut, double, drop, garble, kinds_of

from sonarpost.modem.micromodem import (
    RATES,
    FlexibleDataReceived,
    FrameReceived,
    MiniPacketReceived,
    ModemReady,
    PacketFailed,
    PacketReceived,
    PacketSent,
    PingAnswered,
    RequestDone,
    RequestFailed,
    nmea,
)
from sonarpost.simulation.channel.parameters import ChannelParameters

READY_S = 30.0
RECOVERY_S = 150.0
FRAMES = [b"first of two", b"\x00\xff" * 20]
NEXT = [b"the next packet", b"its second frame"]
UPLINK = [b"what was polled"]

Exchange = Callable[[TwoDrivers], None]


def _packet(rate: int, ack: bool) -> Exchange:
    def start(rig: TwoDrivers) -> None:
        frames = FRAMES[: RATES[rate].frames]
        rig.drivers[1].send_packet(2, rate, [f[: RATES[rate].frame_bytes] for f in frames], ack=ack, now=rig.now)

    return start


EXCHANGES: dict[str, Exchange] = {
    "rate 0": _packet(0, ack=True),
    "rate 4": _packet(4, ack=False),
    "rate 4 with acknowledgement": _packet(4, ack=True),
    "ping": lambda rig: rig.drivers[1].ping(2, rig.now) and None,
    "mini-packet": lambda rig: rig.drivers[1].send_mini(2, 0x1ABC, rig.now) and None,
    "flexible data": lambda rig: rig.drivers[1].send_flexible(2, 1, b"\x00" + b"flexible" * 4, rig.now) and None,
    "poll at rate 0": lambda rig: rig.drivers[1].request_packet(2, 0, now=rig.now) and None,
    "poll at rate 4": lambda rig: rig.drivers[1].request_packet(2, 4, ack=True, now=rig.now) and None,
}
ENDS = (PacketSent, PacketFailed, RequestDone, RequestFailed)


def run_exchange(
    exchange: Exchange, number: int | None, spoil: Spoil, mishap: Callable[[TwoDrivers], None] | None = None
) -> TwoDrivers:
    """Do the exchange with one sentence spoiled or a mishap at that moment, then send the next packet."""
    rig = TwoDrivers(number, spoil, mishap)
    rig.drivers[2].set_poll_handler(lambda polled: UPLINK)
    assert rig.run(READY_S, lambda: all(rig.got(n, ModemReady) for n in (1, 2)))
    rig.run(rig.now + 1.0)
    rig.arm()
    exchange(rig)
    assert rig.run(rig.now + RECOVERY_S, lambda: bool(rig.got(1, *ENDS))), "the exchange has an end"
    rig.run(rig.now + 12.0)  # answers that are still under way are part of it
    rig.armed = False
    if mishap is not None:
        rig.run(rig.now + 12.0)  # it may have come with the very last of them, and is no part of the next packet
    before = len(rig.got(1, *ENDS))
    rig.drivers[1].send_packet(2, 4, NEXT, now=rig.now)
    assert rig.run(rig.now + RECOVERY_S, lambda: len(rig.got(1, *ENDS)) > before), "the next packet has an end"
    rig.run(rig.now + 12.0)
    return rig


def data_of(rig: TwoDrivers, host: int) -> list[bytes]:
    return [event.data for event in rig.got(host, FrameReceived) if isinstance(event, FrameReceived)]


@pytest.mark.parametrize("name", EXCHANGES)
def test_the_exchange_succeeds_when_nothing_is_spoiled(name: str) -> None:
    rig = run_exchange(EXCHANGES[name], None, drop)
    assert isinstance(rig.got(1, *ENDS)[0], PacketSent | RequestDone)
    assert data_of(rig, 2)[-2:] == NEXT
    if name.startswith("rate"):
        assert data_of(rig, 2)[0] == FRAMES[0]
        (first, _) = rig.got(1, PacketSent)
        assert isinstance(first, PacketSent)
        assert first.acknowledged == (() if name == "rate 4" else tuple(range(1, len(first.frames) + 1)))
    if name.startswith("poll"):
        assert data_of(rig, 1) == UPLINK
        (answered,) = rig.got(2, PacketSent)
        assert isinstance(answered, PacketSent)
        assert answered.acknowledged == ((1,) if "4" in name else ())
    if name == "ping":
        assert rig.got(1, PingAnswered) == [PingAnswered(2, 1, 0.1)]
    if name == "mini-packet":
        assert rig.got(2, MiniPacketReceived) == [MiniPacketReceived(1, 2, 0x1ABC)]
    if name == "flexible data":
        (got,) = rig.got(2, FlexibleDataReceived)
        assert isinstance(got, FlexibleDataReceived)
        assert got.packet.data == b"\x00" + b"flexible" * 4


@pytest.mark.parametrize("spoil", [drop, garble, cut, double], ids=lambda spoil: spoil.__name__)
@pytest.mark.parametrize("name", EXCHANGES)
def test_any_sentence_spoiled_once_and_the_next_packet_goes(name: str, spoil: Spoil) -> None:
    baseline = run_exchange(EXCHANGES[name], None, drop)
    count = len(baseline.passed)
    assert count >= 8, kinds_of(baseline.passed)
    good = {FRAMES[0], FRAMES[1], FRAMES[0][:32], *NEXT, *UPLINK}
    for number in range(count):
        rig = run_exchange(EXCHANGES[name], number, spoil)
        what = f"sentence {number}, {rig.spoiled}"
        assert rig.spoiled is not None, what
        assert data_of(rig, 2)[-2:] == NEXT, what
        assert isinstance(rig.got(1, *ENDS)[-1], PacketSent), what
        assert {*data_of(rig, 1), *data_of(rig, 2)} <= good, what
        assert all(driver.ready and not driver.receiving for driver in rig.drivers.values()), what


def _restart(host: int) -> Callable[[TwoDrivers], None]:
    return lambda rig: rig.world.receive(host, nmea.format("CCMSC", host, host, 0), rig.now)


def _unplug(host: int) -> Callable[[TwoDrivers], None]:
    return lambda rig: rig.unplug(host, 3.0)


MISHAPS = {
    "the sender's modem restarts": _restart(1),
    "the receiver's modem restarts": _restart(2),
    "the sender's port goes away": _unplug(1),
    "the receiver's port goes away": _unplug(2),
}


@pytest.mark.parametrize("mishap", MISHAPS)
@pytest.mark.parametrize("name", ["rate 0", "rate 4 with acknowledgement", "ping", "poll at rate 4"])
def test_a_restart_or_a_lost_port_at_any_moment_and_the_next_packet_goes(name: str, mishap: str) -> None:
    count = len(run_exchange(EXCHANGES[name], None, drop).passed)
    for number in range(count):
        rig = run_exchange(EXCHANGES[name], number, lambda line: line, MISHAPS[mishap])
        what = f"sentence {number}, {rig.spoiled}"
        assert rig.spoiled is not None, what
        assert data_of(rig, 2)[-2:] == NEXT, what
        ends = rig.got(1, *ENDS)
        numbers = [getattr(end, "packet_id", None) or getattr(end, "request_id", None) for end in ends]
        assert len(numbers) == len(set(numbers)), what
        assert isinstance(ends[-1], PacketSent), what
        assert all(driver.ready and not driver.receiving for driver in rig.drivers.values()), what


@pytest.mark.parametrize("seed", range(12))
def test_damage_to_any_frame_costs_that_frame(seed: int) -> None:
    rig = TwoDrivers(water=ChannelParameters(seed=seed, frame_loss=0.5))
    assert rig.run(READY_S, lambda: all(rig.got(n, ModemReady) for n in (1, 2)))
    frames = [bytes([n]) * 40 for n in range(1, 9)]
    for _ in range(3):
        rig.drivers[1].send_packet(2, 5, frames, now=rig.now)
    rig.run(rig.now + 60.0)
    packets = [event for event in rig.got(2, PacketReceived) if isinstance(event, PacketReceived)]
    assert len(packets) == 3
    for packet in packets:
        assert len(packet.frames) + packet.bad_frames == 8
        assert all(frame.data == frames[frame.frame_number - 1] for frame in packet.frames)
        assert packet.complete == (len(packet.frames) == 8)
    assert any(packet.bad_frames for packet in packets)


@pytest.mark.parametrize("spoil", [drop, garble, cut, double], ids=lambda spoil: spoil.__name__)
def test_any_sentence_of_the_start_spoiled_once_and_the_modem_is_ready(spoil: Spoil) -> None:
    baseline = TwoDrivers()
    baseline.arm()
    baseline.run(READY_S, lambda: all(baseline.got(n, ModemReady) for n in (1, 2)))
    for number in range(len(baseline.passed)):
        rig = TwoDrivers(number, spoil)
        rig.arm()
        assert rig.run(READY_S, lambda r=rig: all(r.got(n, ModemReady) for n in (1, 2))), rig.spoiled
        rig.drivers[1].send_packet(2, 4, NEXT, now=rig.now)
        assert rig.run(rig.now + RECOVERY_S, lambda r=rig: bool(r.got(1, PacketSent))), rig.spoiled
        rig.run(rig.now + 5.0)
        assert data_of(rig, 2) == NEXT, rig.spoiled
