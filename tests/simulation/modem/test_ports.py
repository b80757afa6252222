"""Drivers of the S2C and of the nanomodem on emulated modems over TCP and pseudo-terminals, in accelerated time."""

from __future__ import annotations

from pathlib import Path

import pytest

from sonarpost.runtime.serial_modem import SerialModem
from sonarpost.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.simulation.channel.emulator import ChannelEmulator

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
                packet = vessel.receive(timeout_s=60)
                assert packet is not None
                assert [(f.src, f.dest, f.data) for f in packet.frames] == [(3, 1, data) for data in frames]
    finally:
        emulator.stop()
