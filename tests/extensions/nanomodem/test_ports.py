"""The nanomodem driver, and another host, on emulated modems over TCP and pseudo-terminals, in accelerated time."""

from pathlib import Path

import pytest
from builders.modem_ports import PORTS, exchange_packets, read_until, sockets

from sonarpost.extensions.nanomodem.emulated import EmulatedNanomodem


@pytest.mark.system
@pytest.mark.parametrize("ports", PORTS)
def test_two_stations_exchange_data_over_ports(ports: str, tmp_path: Path) -> None:
    exchange_packets("nano", [(1, [b"$B02#TO\r\n"])], PORTS[ports], tmp_path)


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
