"""Drivers of the S2C and of the nanomodem on emulated modems over TCP and pseudo-terminals, in accelerated time."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from builders.common import WAIT_S

from sonarpost.extensions.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.extensions.simulation.modem.nanomodem import EmulatedNanomodem
from sonarpost.runtime.serial_modem import SerialModem

HOSTILE = b"\r\nDELIVEREDIM,3\r\n+++AT:13:DELIVEREDIM,3\r\n,\x00\xff"
PACKETS = {"s2c": ((0, [HOSTILE]), (1, [HOSTILE.ljust(64, b"\n")] * 16)), "nano": ((1, [b"$B02#TO\r\n"]),)}


@pytest.mark.system
@pytest.mark.parametrize("tcp_ports", [(0, 0), ()], ids=["tcp", "serial"])
@pytest.mark.parametrize("driver", PACKETS)
def test_two_stations_exchange_data_over_ports(driver: str, tcp_ports: tuple[int, ...], tmp_path: Path) -> None:
    sites = (ModemSite(address=1), ModemSite(address=3))
    emulator = ChannelEmulator(
        EmulatorConfig(modem=sites, tcp_ports=tcp_ports, pty_dir=tmp_path, time_scale=20.0, driver=driver)
    )
    emulator.start()
    try:
        one, two = (device.device for device in emulator.devices())
        with (
            SerialModem(one, address=1, driver=driver) as vessel,
            SerialModem(two, address=3, driver=driver) as vehicle,
        ):
            for rate, frames in PACKETS[driver]:
                sent = vehicle.send(frames, destination=1, rate=rate, ack=True)
                assert sent.acknowledged == tuple(range(1, len(frames) + 1))
                packet = vessel.receive(timeout_s=WAIT_S)
                assert packet is not None
                assert [(f.src, f.dest, f.data) for f in packet.frames] == [(3, 1, data) for data in frames]
    finally:
        emulator.stop()


@contextmanager
def sockets(driver: str) -> Iterator[list[socket.socket]]:
    """Two emulated modems, each with a plain TCP client."""
    sites = (ModemSite(address=1), ModemSite(address=2))
    emulator = ChannelEmulator(EmulatorConfig(modem=sites, tcp_ports=(0, 0), time_scale=20.0, driver=driver))
    emulator.start()
    try:
        with ExitStack() as stack:
            places = [device.device.removeprefix("socket://").split(":") for device in emulator.devices()]
            yield [
                stack.enter_context(socket.create_connection((host, int(port)), timeout=WAIT_S))
                for host, port in places
            ]
    finally:
        emulator.stop()


def read_until(client: socket.socket, end: bytes) -> bytes:
    """Return the bytes of a modem up to an end; the client's time-out limits the wait."""
    data = b""
    while not data.endswith(end):
        received = client.recv(4096)
        assert received, data
        data += received
    return data


@pytest.mark.system
def test_burst_data_without_extended_notifications_and_raw_data_over_ports() -> None:
    with sockets("s2c") as (one, two):
        for client in (one, two):
            client.sendall(b"+++ATC\n")
            assert read_until(client, b"\n") == b"+++ATC:2:OK\r\n"
        for number in (1, 2):
            one.sendall(b"AT*SEND,10,2,\r\n+++AT\0\xff%d\n" % number)
            assert read_until(one, b",2\r\n") == b"OK\r\nDELIVERED,%d,2\r\n" % number
            assert read_until(two, b"%d\r\n" % number).endswith(b",0.0000,\r\n+++AT\0\xff%d\r\n" % number)
        for client in (one, two):
            client.sendall(b"ATO\n")
            assert read_until(client, b"\n") == b"OK\r\n"
        two.sendall(b"raw data\n")
        assert read_until(one, b"\n") == b"raw data\n"


def test_output_without_bytes_does_not_stop_the_outputs_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    read_input = EmulatedNanomodem._read_input

    def write_nothing_first(modem: EmulatedNanomodem, now: float) -> None:
        modem._write(b"")
        read_input(modem, now)

    monkeypatch.setattr(EmulatedNanomodem, "_read_input", write_nothing_first)
    with sockets("nano") as (one, _):
        for _ in range(2):
            one.sendall(b"$?")
            assert read_until(one, b"\n").startswith(b"#A001V")
