"""WHOI's unmodified client on both modems of the emulator: every rate in both directions, byte for byte."""

import logging
import queue
import threading
import warnings
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from builders.common import WAIT_S, eventually

from sonarpost.extensions.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.modem.micromodem import RATES

with warnings.catch_warnings():
    # Strings of the package have escapes that Python reports as deprecated when it compiles them.
    warnings.filterwarnings("ignore", category=DeprecationWarning, module=r"acomms(\.|$)")
    warnings.filterwarnings("ignore", message="invalid escape sequence", category=DeprecationWarning)
    acomms = pytest.importorskip("acomms", reason="acomms, WHOI's client, is not installed")
    from acomms.unifiedlog import UnifiedLog

pytestmark = [pytest.mark.system, pytest.mark.filterwarnings("ignore:setDaemon:DeprecationWarning")]

RANGE_M = 150.0
SCALE = 20.0
SET_UTC = datetime(2024, 2, 29, 23, 59, 50, tzinfo=UTC)


class Client:
    """One client of WHOI and what it receives."""

    def __init__(self, name: str, device: str, folder: Path) -> None:
        log = UnifiedLog(log_path=str(folder), file_name=f"{name}.log", rootname=f"acomms-{name}")
        self.modem = acomms.Micromodem(name=name, unified_log=log, respond_to_uplinks=True)
        self.log = log
        self.frames: queue.Queue[Any] = queue.Queue()
        self.statistics: queue.Queue[Any] = queue.Queue()
        self.sent: queue.Queue[Any] = queue.Queue()
        self.packets: list[Any] = []
        self.acks: list[tuple[int, int, int]] = []
        self.pings: list[Any] = []
        self.minis: list[Any] = []
        self.flexible: list[Any] = []
        self.modem.attach_incoming_dataframe_queue(self.frames)
        self.modem.attach_incoming_cst_queue(self.statistics)
        self.modem.attach_incoming_xst_queue(self.sent)
        self.modem.packetrx_listeners.append(self.packets.append)
        self.modem.ack_listeners.append(lambda ack, _: self.acks.append((ack.src, ack.dest, ack.frame_num)))
        self.modem.mpr_listeners.append(self.pings.append)
        self.modem.camua_listeners.append(self.minis.append)
        self.modem.fdp_listeners.append(self.flexible.append)
        self.modem.connect_serial(device)

    def idle(self) -> bool:
        return str(self.modem.state) == "Idle"

    def close(self) -> None:
        """Close the client. Its reading thread never ends and would reopen the port, so it is blocked for good."""
        connection, asleep, never = self.modem.connection, threading.Event(), threading.Event()

        def sleep() -> None:
            asleep.set()
            never.wait()

        connection.readline = sleep
        assert asleep.wait(WAIT_S)
        connection._serialport.close()
        self.log._log.removeHandler(self.log._file_handler)
        self.log._file_handler.close()


@pytest.fixture
def clients(tmp_path: Path) -> Iterator[tuple[Client, Client]]:
    modems = (ModemSite(address=1), ModemSite(address=2, east_m=RANGE_M))
    channel = ChannelEmulator(EmulatorConfig(modem=modems, pty_dir=tmp_path / "modems", time_scale=SCALE))
    channel.start()
    pair = [Client(f"m{d.address}", d.device, tmp_path) for d in channel.devices()]
    yield pair[0], pair[1]
    for client in pair:
        client.close()
    channel.stop()
    logging.getLogger("acomms-m1").handlers.clear()


def test_client_reads_its_address_at_start(clients: tuple[Client, Client]):
    assert [client.modem.id for client in clients] == [1, 2]
    assert [client.modem.config_data["SRC"] for client in clients] == ["1", "2"]
    eventually(lambda: clients[0].modem.fw_version == "2.0.27087", what="CAREV")
    assert clients[0].modem.set_config("CST", 1) == {"CST", "1"}
    assert clients[0].modem.get_config("DTO") is not None
    assert clients[0].modem.query_nmea_api_level() == 11


@pytest.mark.parametrize("rate", sorted(RATES))
def test_full_packet_in_both_directions(clients: tuple[Client, Client], rate: int):
    shape = RATES[rate]
    for sender, receiver in (clients, clients[::-1]):
        data = bytes((7 * n + rate + sender.modem.id) % 256 for n in range(shape.packet_bytes))
        sender.modem.send_packet_data(receiver.modem.id, bytearray(data), rate, ack=True)
        got = [receiver.frames.get(timeout=120) for _ in range(shape.frames)]
        assert b"".join(bytes(frame.data) for frame in got) == data
        assert [(f.src, f.dest, f.frame_num) for f in got] == [
            (sender.modem.id, receiver.modem.id, n) for n in range(1, shape.frames + 1)
        ]
        expected = [(receiver.modem.id, sender.modem.id, n) for n in range(1, shape.frames + 1)]
        eventually(lambda s=sender, e=expected: s.acks == e, what="acknowledgement of every frame")
        eventually(lambda r=receiver: len(r.packets) == 1, what="a complete packet")
        assert b"".join(bytes(frame.data) for frame in receiver.packets[0].frames) == data
        # A client that acknowledges blocks until its reply is transmitted.
        eventually(lambda r=receiver, s=sender: r.idle() and s.idle(), what="both clients idle")
        csts = [receiver.statistics.get(timeout=120) for _ in range(2 if rate == 0 else 1)]
        assert (csts[-1]["mode"], csts[-1]["rate_num"], csts[-1]["num_frames"]) == (0, rate, shape.frames)
        assert (csts[-1]["src"], csts[-1]["dest"]) == (sender.modem.id, receiver.modem.id)
        xsts = [sender.sent.get(timeout=120) for _ in range(2 if rate == 0 else 1)]
        assert (xsts[-1]["nbytes"], xsts[-1]["num_frames_sent"]) == (shape.packet_bytes, shape.frames)
        sender.statistics.get(timeout=120)  # those of the acknowledgement
        for client in clients:
            client.acks.clear()
            client.packets.clear()
            client.statistics.queue.clear()
            client.sent.queue.clear()


def test_ping_and_mini_packet(clients: tuple[Client, Client]):
    one, two = clients
    one.modem.send_ping(2)
    eventually(lambda: len(one.pings) == 1, what="reply to the ping")
    assert (one.pings[0].src, one.pings[0].dest, one.pings[0].owtt) == (2, 1, pytest.approx(RANGE_M / 1500.0))
    eventually(lambda: len(one.statistics.queue) == 1 and len(two.statistics.queue) == 1, what="statistics of the ping")
    two.modem.send_minipacket(1, "1A2B")
    eventually(lambda: len(one.minis) == 1, what="mini-packet")
    assert (one.minis[0].src, one.minis[0].dest, bytes(one.minis[0].data)) == (2, 1, b"\x1a\x2b")


def test_clock_is_set(clients: tuple[Client, Client]):
    answer = clients[0].modem.set_time(SET_UTC)
    assert answer is not None
    assert answer.time == SET_UTC


@pytest.mark.parametrize("rate", [0, 1])
def test_poll(clients: tuple[Client, Client], rate: int):
    one, two = clients
    requests: list[Any] = []

    def uplink(request: Any) -> bytearray:
        requests.append(request)
        return bytearray(b"requested data")

    two.modem.set_uplink_data_function(uplink)
    one.modem.send_uplink_request(2, rate_num=rate)
    frame = one.frames.get(timeout=120)
    assert (frame.src, frame.dest, bytes(frame.data)) == (2, 1, b"requested data")
    assert [(r.src, r.dest, r.num_bytes, r.frame_num) for r in requests] == [(2, 1, RATES[rate].frame_bytes, 1)]
    eventually(lambda: one.idle() and two.idle(), what="both clients idle")


def test_flexible_data(clients: tuple[Client, Client]):
    one, two = clients
    data = bytes(range(80))
    packet = acomms.FDPacket(None, 2, None, 1, False, databytes=data)
    one.modem.send_fdpacket(packet, use_tdp=True)
    eventually(lambda: len(two.flexible) == 1, what="flexible data")
    got = two.flexible[0]
    assert (got.src, got.dest, got.packet_is_good, bytes(got.databytes)) == (1, 2, True, data)
    assert got.cyclestats["packet_type"] == 5
    eventually(one.idle, what="an idle sender")
