"""The S2C driver, and other hosts, on emulated modems over TCP and pseudo-terminals, in accelerated time."""

from pathlib import Path

import pytest
from builders.modem_ports import PORTS, exchange_packets, read_until, sockets

HOSTILE = b"\r\nDELIVEREDIM,3\r\n+++AT:13:DELIVEREDIM,3\r\n,\x00\xff"


@pytest.mark.system
@pytest.mark.parametrize("ports", PORTS)
def test_two_stations_exchange_data_over_ports(ports: str, tmp_path: Path) -> None:
    packets = ((0, [HOSTILE]), (1, [HOSTILE.ljust(64, b"\n")] * 16))
    exchange_packets("s2c", packets, PORTS[ports], tmp_path)


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
