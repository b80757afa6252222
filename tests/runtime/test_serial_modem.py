"""SerialModem against two emulated modems on pseudo-terminals."""

import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import pytest
from builders.common import eventually

from sonarpost.errors import ConfigError, FrameError, PortError, TransmissionError
from sonarpost.extensions.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.runtime import serial_modem
from sonarpost.runtime.serial_modem import SerialModem


@pytest.fixture
def channel(tmp_path, request):
    modems = (ModemSite(address=1), ModemSite(address=3, east_m=150.0))
    time_scale = getattr(request, "param", 150.0)
    emulator = ChannelEmulator(EmulatorConfig(modem=modems, pty_dir=tmp_path / "modems", time_scale=time_scale))
    emulator.start()
    yield emulator
    emulator.stop()


@pytest.fixture
def ports(channel):
    return {device.address: device.device for device in channel.devices()}


def test_a_packet_is_sent_and_received(ports):
    with SerialModem(ports[1], address=1) as vessel, SerialModem(ports[3], address=3) as vehicle:
        assert vehicle.is_ready
        sent = vehicle.send([b"first", b"second"], destination=1, rate=1)
        assert (sent.dest, sent.rate, sent.frames) == (1, 1, (b"first", b"second"))
        packet = vessel.receive(timeout_s=120)
        assert packet is not None
        assert (packet.src, [frame.data for frame in packet.frames]) == (3, [b"first", b"second"])
        assert vessel.receive(timeout_s=0.05) is None
    assert not vehicle.is_ready


def test_acknowledgements_are_returned(ports):
    with SerialModem(ports[1], address=1), SerialModem(ports[3], address=3) as vehicle:
        assert vehicle.send([b"data"], destination=1, rate=0, ack=True).acknowledged == (1,)


def test_packets_wait_for_receive_and_the_oldest_is_dropped(ports, monkeypatch):
    arrived = []

    class CountingDeque(deque):
        def append(self, packet):
            super().append(packet)
            arrived.append(packet)

    monkeypatch.setattr(serial_modem, "MAX_RECEIVED_PACKETS", 2)
    monkeypatch.setattr(serial_modem, "deque", CountingDeque)
    with SerialModem(ports[1], address=1) as vessel, SerialModem(ports[3], address=3) as vehicle:
        for number in range(3):
            vehicle.send([bytes([number])], destination=1, rate=1)
        eventually(lambda: len(arrived) == 3)
        packets = [vessel.receive(timeout_s=0.0) for _ in range(3)]
    assert [packet and packet.frames[0].data for packet in packets] == [b"\x01", b"\x02", None]


def test_invalid_packets_and_a_closed_modem_raise(ports):
    modem = SerialModem(ports[3], address=3)
    with pytest.raises(PortError, match="not open"):
        modem.send([b"x"], destination=1, rate=1)
    with modem:
        with pytest.raises(FrameError):
            modem.send([b"x"], destination=1, rate=9)
        with pytest.raises(FrameError):
            modem.send([b"x" * 100], destination=1, rate=1)
        with pytest.raises(PortError, match="already started"):
            modem.open()
    with modem:
        assert modem.send([b"again"], destination=1, rate=1).frames == (b"again",)


def test_invalid_configurations_raise():
    with pytest.raises(ConfigError):
        SerialModem("carrier-pigeon://1", address=1)
    with pytest.raises(ConfigError):
        SerialModem("loop://", address=200)


def test_a_port_that_cannot_be_opened_is_named(tmp_path):
    with pytest.raises(PortError, match=r"ttyNONE: not ready within 0\.3 s: .*No such file"):
        SerialModem(str(tmp_path / "ttyNONE"), address=1, ready_timeout_s=0.3).open()


def test_a_modem_that_does_not_reply_is_named():
    with pytest.raises(PortError, match=r"not ready within 0\.3 s: no reply from the modem"):
        SerialModem("loop://", address=1, ready_timeout_s=0.3).open()


@pytest.mark.parametrize("channel", [0.01], indirect=True)  # the packet lasts longer than the test
def test_close_ends_send_and_receive_in_other_threads(ports):
    modem = SerialModem(ports[3], address=3)
    modem.open()
    started = threading.Barrier(3)
    with ThreadPoolExecutor() as pool:
        sending = pool.submit(lambda: (started.wait(), modem.send([b"x"] * 3, destination=1, rate=1, ack=True)))
        receiving = pool.submit(lambda: (started.wait(), modem.receive())[1])
        started.wait()
        eventually(lambda: modem._runner.queued > 0)
        modem.close()
        with pytest.raises(TransmissionError, match="not sent"):
            sending.result(timeout=120)
        assert receiving.result(timeout=120) is None
