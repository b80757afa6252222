"""One fault in any sentence of any exchange: the sentence is lost, corrupted, truncated or duplicated.

Two drivers run on two emulated modems. A fault may fail its own exchange. It never affects the next exchange, never
changes a byte of a frame, and its delay is bounded.
"""

from collections.abc import Callable

import pytest
from builders.two_drivers import Fault, TwoDrivers, corrupt, drop, duplicate, kinds_of, truncate

from sonarpost.extensions.simulation.channel.parameters import ChannelParameters
from sonarpost.modem.interface import (
    FrameReceived,
    ModemError,
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
)
from sonarpost.modem.micromodem import RATES, nmea

READY_S = 30.0
RECOVERY_S = 150.0
FRAMES = [b"first of two", b"\x00\xff" * 20]
NEXT = [b"the next packet", b"its second frame"]
POLLED = [b"polled"]

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
    "poll at rate 0": lambda rig: rig.drivers[1].request_packet(2, 0, now=rig.now) and None,
    "poll at rate 4": lambda rig: rig.drivers[1].request_packet(2, 4, ack=True, now=rig.now) and None,
}
ENDS = (PacketSent, PacketFailed, RequestDone, RequestFailed)


def run_exchange(
    exchange: Exchange, number: int | None, fault: Fault, disturbance: Callable[[TwoDrivers], None] | None = None
) -> TwoDrivers:
    """Run the exchange with a fault or a disturbance at one sentence, then send the next packet."""
    rig = TwoDrivers(number, fault, disturbance)
    rig.drivers[2].set_poll_handler(lambda polled: POLLED)
    assert rig.run(READY_S, lambda: all(rig.events_of(n, ModemReady) for n in (1, 2)))
    rig.run(rig.now + 1.0)
    rig.start_counting()
    exchange(rig)
    assert rig.run(rig.now + RECOVERY_S, lambda: bool(rig.events_of(1, *ENDS))), "the exchange ends"
    rig.run(rig.now + 12.0)  # answers in flight belong to the exchange
    rig.counting = False
    if disturbance is not None:
        rig.run(rig.now + 12.0)  # a disturbance at the last sentence must not affect the next packet
    before = len(rig.events_of(1, *ENDS))
    rig.drivers[1].send_packet(2, 4, NEXT, now=rig.now)
    assert rig.run(rig.now + RECOVERY_S, lambda: len(rig.events_of(1, *ENDS)) > before), "the next packet ends"
    rig.run(rig.now + 12.0)
    return rig


def data_of(rig: TwoDrivers, host: int) -> list[bytes]:
    return [event.data for event in rig.events_of(host, FrameReceived) if isinstance(event, FrameReceived)]


@pytest.mark.parametrize("ack", [False, True])
@pytest.mark.parametrize("rate", RATES)
def test_full_packets_of_every_rate_arrive(rate: int, ack: bool) -> None:
    rig, shape = TwoDrivers(), RATES[rate]
    rig.run(40.0)
    rig.events[1].clear()
    rig.events[2].clear()
    frames = tuple(bytes([n + 1]) * (shape.frame_bytes - n) for n in range(shape.frames))
    for end_s in (70.0, 100.0):
        rig.drivers[1].send_packet(2, rate, frames, ack=ack, now=rig.now)
        rig.run(end_s)
    sent = [event for event in rig.events_of(1, PacketSent) if isinstance(event, PacketSent)]
    assert [event.acknowledged for event in sent] == [tuple(range(1, shape.frames + 1)) if ack else ()] * 2
    got = [event for event in rig.events_of(2, PacketReceived) if isinstance(event, PacketReceived)]
    assert [tuple(frame.data for frame in packet.frames) for packet in got] == [frames] * 2
    assert all(packet.complete and packet.rate == rate and packet.statistics is not None for packet in got)
    problems = (PacketFailed, ModemError, SentenceRejected, ModemRebooted, ModemUnresponsive)
    assert not [*rig.events_of(1, *problems), *rig.events_of(2, *problems)]


@pytest.mark.parametrize("name", [name for name in EXCHANGES if not name.startswith("rate")])
def test_exchange_succeeds_without_a_fault(name: str) -> None:
    rig = run_exchange(EXCHANGES[name], None, drop)
    assert isinstance(rig.events_of(1, *ENDS)[0], PacketSent | RequestDone)
    assert data_of(rig, 2)[-2:] == NEXT
    if name.startswith("poll"):
        assert data_of(rig, 1) == POLLED
        (answered,) = rig.events_of(2, PacketSent)
        assert isinstance(answered, PacketSent)
        assert answered.acknowledged == ((1,) if "4" in name else ())
    if name == "ping":
        assert rig.events_of(1, RangeMeasured) == [RangeMeasured(2, 1, 0.1)]


FAULTS = {fault.__name__: fault for fault in (drop, corrupt, truncate, duplicate)}
ALL_FAULTS = [
    pytest.param(name, fault, marks=[] if fault == "drop" or "acknowledgement" in name else pytest.mark.system)
    for name in EXCHANGES
    for fault in FAULTS
]


@pytest.mark.parametrize(("name", "fault"), ALL_FAULTS)
def test_next_packet_is_sent_after_a_fault_in_any_sentence(name: str, fault: str) -> None:
    baseline = run_exchange(EXCHANGES[name], None, drop)
    count = len(baseline.transferred)
    assert count >= 8, kinds_of(baseline.transferred)
    good = {FRAMES[0], FRAMES[1], FRAMES[0][:32], *NEXT, *POLLED}
    for number in range(count):
        rig = run_exchange(EXCHANGES[name], number, FAULTS[fault])
        where = f"sentence {number}, {rig.faulty}"
        assert rig.faulty is not None, where
        assert data_of(rig, 2)[-2:] == NEXT, where
        assert isinstance(rig.events_of(1, *ENDS)[-1], PacketSent), where
        assert {*data_of(rig, 1), *data_of(rig, 2)} <= good, where
        assert all(driver.ready and not driver.receiving for driver in rig.drivers.values()), where


def _restart(host: int) -> Callable[[TwoDrivers], None]:
    return lambda rig: rig.simulator.receive(host, nmea.format("CCMSC", host, host, 0), rig.now)


def _unplug(host: int) -> Callable[[TwoDrivers], None]:
    return lambda rig: rig.unplug(host, 3.0)


DISTURBANCES = {
    "the sender's modem restarts": _restart(1),
    "the receiver's modem restarts": _restart(2),
    "the sender's port is lost": _unplug(1),
    "the receiver's port is lost": _unplug(2),
}


@pytest.mark.parametrize("disturbance", DISTURBANCES)
@pytest.mark.parametrize(
    "name",
    [
        "rate 4 with acknowledgement",
        *(pytest.param(name, marks=pytest.mark.system) for name in ("rate 0", "ping", "poll at rate 4")),
    ],
)
def test_next_packet_is_sent_after_a_disturbance_at_any_sentence(name: str, disturbance: str) -> None:
    count = len(run_exchange(EXCHANGES[name], None, drop).transferred)
    for number in range(count):
        rig = run_exchange(EXCHANGES[name], number, lambda line: line, DISTURBANCES[disturbance])
        where = f"sentence {number}, {rig.faulty}"
        assert rig.faulty is not None, where
        assert data_of(rig, 2)[-2:] == NEXT, where
        ends = rig.events_of(1, *ENDS)
        numbers = [getattr(end, "packet_id", None) or getattr(end, "request_id", None) for end in ends]
        assert len(numbers) == len(set(numbers)), where
        assert isinstance(ends[-1], PacketSent), where
        assert all(driver.ready and not driver.receiving for driver in rig.drivers.values()), where


@pytest.mark.parametrize("seed", range(3))
def test_damaged_frame_loses_only_that_frame(seed: int) -> None:
    rig = TwoDrivers(parameters=ChannelParameters(seed=seed, frame_loss=0.5))
    assert rig.run(READY_S, lambda: all(rig.events_of(n, ModemReady) for n in (1, 2)))
    frames = [bytes([n]) * 40 for n in range(1, 9)]
    for _ in range(3):
        rig.drivers[1].send_packet(2, 5, frames, now=rig.now)
    rig.run(rig.now + 60.0)
    packets = [event for event in rig.events_of(2, PacketReceived) if isinstance(event, PacketReceived)]
    assert len(packets) == 3
    for packet in packets:
        assert len(packet.frames) + packet.bad_frames == 8
        assert all(frame.data == frames[frame.frame_number - 1] for frame in packet.frames)
        assert packet.complete == (len(packet.frames) == 8)
    assert any(packet.bad_frames for packet in packets)


@pytest.mark.parametrize(
    "fault", ["drop", *(pytest.param(name, marks=pytest.mark.system) for name in ("corrupt", "truncate", "duplicate"))]
)
def test_modem_is_ready_after_a_fault_in_any_start_up_sentence(fault: str) -> None:
    baseline = TwoDrivers()
    baseline.start_counting()
    baseline.run(READY_S, lambda: all(baseline.events_of(n, ModemReady) for n in (1, 2)))
    for number in range(len(baseline.transferred)):
        rig = TwoDrivers(number, FAULTS[fault])
        rig.start_counting()
        assert rig.run(READY_S, lambda r=rig: all(r.events_of(n, ModemReady) for n in (1, 2))), rig.faulty
        rig.drivers[1].send_packet(2, 4, NEXT, now=rig.now)
        assert rig.run(rig.now + RECOVERY_S, lambda r=rig: bool(r.events_of(1, PacketSent))), rig.faulty
        rig.run(rig.now + 5.0)
        assert data_of(rig, 2) == NEXT, rig.faulty
