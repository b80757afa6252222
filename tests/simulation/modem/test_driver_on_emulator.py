"""The driver on the emulated modem: packets, reboots, lost frames and collisions."""

from __future__ import annotations

import pytest
from builders.emulator_bench import EmulatorBench

from sonarpost.modem.interface import (
    ModemError,
    ModemEvent,
    ModemRebooted,
    ModemUnresponsive,
    PacketFailed,
    PacketReceived,
    PacketSent,
    SentenceRejected,
)
from sonarpost.modem.micromodem import RATES, MicroModem, MicroModemConfig


def drive(bench: EmulatorBench, drivers: dict[int, MicroModem], until_s: float) -> dict[int, list[ModemEvent]]:
    """Run the drivers on simulated time."""
    events: dict[int, list[ModemEvent]] = {n: [] for n in drivers}
    while bench.now < until_s:
        for n, driver in drivers.items():
            sentences, bench.output[n] = bench.output[n], b""
            events[n] += driver.receive(sentences, bench.now) + driver.poll(bench.now)
            bench.simulator.receive(n, driver.bytes_to_send(), bench.now)
        bench.advance(round(bench.now + 0.05, 6))
    return events


@pytest.mark.parametrize("rate", sorted(RATES))
@pytest.mark.parametrize("ack", [False, True])
def test_packets_between_two_drivers(rate: int, ack: bool):
    bench = EmulatorBench()
    drivers = {n: MicroModem(MicroModemConfig(n)) for n in (1, 2)}
    for driver in drivers.values():
        driver.start(bench.now)
    drive(bench, drivers, 10.0)
    assert all(driver.ready for driver in drivers.values())
    shape = RATES[rate]
    frames = [bytes([n + 1]) * (shape.frame_bytes - n) for n in range(shape.frames)]
    for n in range(2):
        drivers[1].send_packet(2, rate, frames, ack=ack, now=bench.now + n / 1000)
    events = drive(bench, drivers, 70.0)

    sent = [event for event in events[1] if isinstance(event, PacketSent)]
    assert [event.acknowledged for event in sent] == [tuple(range(1, shape.frames + 1)) if ack else ()] * 2
    assert all(event.statistics is not None and event.statistics.nbytes == sum(map(len, frames)) for event in sent)
    got = [event for event in events[2] if isinstance(event, PacketReceived)]
    assert [[frame.data for frame in packet.frames] for packet in got] == [frames] * 2
    assert all(packet.complete and packet.rate == rate and packet.statistics is not None for packet in got)
    unwanted = (PacketFailed, ModemError, SentenceRejected, ModemRebooted, ModemUnresponsive)
    assert not [event for n in events for event in events[n] if isinstance(event, unwanted)]


@pytest.mark.parametrize("off", [("TXF", "XST"), ("TXP", "TXF", "XST")])
@pytest.mark.parametrize("before_start", [True, False])
@pytest.mark.parametrize("rate", [0, 4])
def test_packets_are_sent_once_by_a_modem_with_reports_off(off: tuple[str, ...], before_start: bool, rate: int):
    """The settings are in the modem's memory at the start, or another program switches them off afterwards."""
    bench = EmulatorBench()
    drivers = {n: MicroModem(MicroModemConfig(n)) for n in (1, 2)}
    switch_off = [("CCCFG", name, 0) for name in off]
    if before_start:
        bench.send(1, *switch_off)
        bench.clear_output()
    for driver in drivers.values():
        driver.start(bench.now)
    drive(bench, drivers, 10.0)
    if not before_start:
        bench.send(1, *switch_off)
    packets = [[bytes([n]) * 20] for n in range(3)]
    for frames in packets:
        drivers[1].send_packet(2, rate, frames, now=bench.now)
    events = drive(bench, drivers, 120.0)
    assert [e.frames for e in events[1] if isinstance(e, PacketSent)] == [tuple(frames) for frames in packets]
    assert [e for e in events[1] if isinstance(e, PacketFailed)] == []
    got = [event for event in events[2] if isinstance(event, PacketReceived)]
    assert [[frame.data for frame in packet.frames] for packet in got] == packets


def test_driver_recovers_from_a_modem_reboot():
    bench = EmulatorBench()
    driver = MicroModem(MicroModemConfig(1))
    driver.start(bench.now)
    drive(bench, {1: driver}, 10.0)
    bench.send(1, ("CCMSC", 1, 1, 0))
    events = drive(bench, {1: driver}, 30.0)[1]
    assert sum(isinstance(event, ModemRebooted) for event in events) == 1
    assert driver.ready
    driver.send_packet(2, 1, [b"after"], now=bench.now)
    drive(bench, {1: driver}, 45.0)
    assert "CARXD,1,2,0,1,6166746572" in bench.sentences(2)


def test_driver_reports_lost_frames_and_collisions():
    bench = EmulatorBench(modems=3, frame_loss=0.4, seed=2)
    drivers = {n: MicroModem(MicroModemConfig(n)) for n in (1, 2, 3)}
    for driver in drivers.values():
        driver.start(bench.now)
    drive(bench, drivers, 10.0)
    frames = [bytes([n]) * 8 for n in range(1, 9)]
    drivers[1].send_packet(2, 5, frames, now=bench.now)
    events = drive(bench, drivers, 20.0)
    (packet,) = (event for event in events[2] if isinstance(event, PacketReceived))
    sentences = next(r for r in bench.reports if r.arrival.receiver == 2)
    good = [frame.received for frame in sentences.arrival.frames if frame.outcome.value == "delivered"]
    assert [frame.data for frame in packet.frames] == good
    assert packet.bad_frames == 8 - len(good) > 0
    assert not packet.complete
    for n in (1, 3):
        drivers[n].send_packet(2, 1, [b"clash"], now=bench.now)
    events = drive(bench, drivers, 40.0)
    assert not [event for event in events[2] if isinstance(event, PacketReceived) and event.frames]
    assert not drivers[2].receiving
    assert all(driver.ready for driver in drivers.values())
