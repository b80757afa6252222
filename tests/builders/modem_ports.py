"""Drivers on emulated modems over TCP and pseudo-terminals, in accelerated time."""

import socket
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from builders.common import WAIT_S
from sonarpost.extensions.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.runtime.serial_modem import SerialModem

PORTS = {"tcp": (0, 0), "serial": ()}


def exchange_packets(
    driver: str, packets: Iterable[tuple[int, list[bytes]]], tcp_ports: tuple[int, ...], pty_dir: Path
) -> None:
    """Send packets of a rate from one station to another over TCP or pseudo-terminals, and check what arrives."""
    sites = (ModemSite(address=1), ModemSite(address=3))
    emulator = ChannelEmulator(
        EmulatorConfig(modem=sites, tcp_ports=tcp_ports, pty_dir=pty_dir, time_scale=20.0, driver=driver)
    )
    emulator.start()
    try:
        one, two = (device.device for device in emulator.devices())
        with (
            SerialModem(one, address=1, driver=driver) as vessel,
            SerialModem(two, address=3, driver=driver) as vehicle,
        ):
            for rate, frames in packets:
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
