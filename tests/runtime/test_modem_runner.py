import logging
import os
import pty
import queue
import threading
import time
import tty
from types import SimpleNamespace

import pytest
from builders.common import WAIT_S, eventually

from sonarpost.errors import FrameError, PortError
from sonarpost.extensions.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.modem.interface import (
    FrameReceived,
    ModemEvent,
    ModemReady,
    PacketFailed,
    PacketReceived,
    PacketSent,
    RangeMeasured,
    RequestDone,
    SentenceRejected,
)
from sonarpost.modem.micromodem import (
    FailureReason,
    MicroModem,
    MicroModemConfig,
    nmea,
)
from sonarpost.modem.registry import ModemSettings
from sonarpost.modem.udp import UdpModem
from sonarpost.modem.udp.datagram import Datagram, DatagramKind
from sonarpost.runtime import modem_runner, serial_port
from sonarpost.runtime.modem_runner import MAX_INPUTS, ModemRunner
from sonarpost.runtime.serial_port import ModemPort, PortOpened, SerialPort

CONFIG = MicroModemConfig(address=3, settings=())


class PtyModem:
    """A modem on a pseudo-terminal that replies at once and transmits in no time."""

    def __init__(self, path):
        self.path = path
        self.replies = True
        self.commands: list[nmea.Sentence] = []
        self.plug()

    def plug(self):
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)
        self._plugged = True
        self._unplugged = threading.Event()
        self._thread = threading.Thread(target=self._serve, args=(self.master,), daemon=True)
        self._thread.start()

    def unplug(self):
        if self._plugged:
            self._plugged = False
            self.path.unlink()
            os.close(self.master)
            self._thread.join(WAIT_S)

    def write(self, kind, *fields):
        os.write(self.master, nmea.format(kind, *fields))

    def _serve(self, master):
        lines = nmea.LineAssembler()
        os.set_blocking(master, False)
        while self._plugged:
            try:
                items = lines.feed(os.read(master, 4096))
            except OSError:
                # Nothing arrived, the other side is not open, or unplugged.
                self._unplugged.wait(0.002)
                continue
            for sentence in items:
                assert isinstance(sentence, nmea.Sentence)
                self.commands.append(sentence)
                if self.replies:
                    self._reply(*([sentence.kind, *sentence.fields]))

    def _reply(self, kind, *fields):
        if kind == "CCCFG":
            self.write("CACFG", *fields)
        elif kind == "CCCFQ":
            self.write("CACFG", fields[0], {"SRC": 3, "CST": 1}[fields[0]])
        elif kind == "CCCLK":
            self.write("CACLK", *fields)
        elif kind == "CCCYC":
            self.write("CACYC", *fields)
            self.write("CADRQ", "000000", *fields[1:3], fields[4], 256, 1)
        elif kind == "CCTXD":
            size = len(fields[3]) // 2
            self.write("CATXD", *fields[:3], size)
            self.write("CATXP", size)
            self.write("CATXF", size)
            self.write("CAXST", 7, "20250606", "230117.336548")


class Rig:
    def __init__(self, modem):
        self.modem = modem
        self.events: list[ModemEvent] = []
        self.port = SerialPort(str(modem.path))
        self.runner = ModemRunner(MicroModem(CONFIG), self.port, self.events.append)

    def of(self, *kinds):
        return [event for event in self.events if isinstance(event, kinds)]


@pytest.fixture
def rig(tmp_path, monkeypatch):
    monkeypatch.setattr(serial_port, "FIRST_RETRY_S", 0.02)
    monkeypatch.setattr(serial_port, "MAX_RETRY_S", 0.1)
    modem = PtyModem(tmp_path / "ttyMODEM")
    rig = Rig(modem)
    rig.runner.start()
    yield rig
    rig.runner.stop()
    modem.unplug()


def test_the_runner_configures_sends_and_receives(rig):
    eventually(lambda: rig.runner.ready)
    assert rig.events == [ModemReady(3, None)]
    packet_id = rig.runner.send_packet(1, 4, [b"snippet"])
    eventually(lambda: rig.of(PacketSent))
    (sent,) = rig.of(PacketSent)
    assert (sent.packet_id, sent.frames) == (packet_id, (b"snippet",))
    assert rig.modem.commands[-1].fields == ("3", "1", "0", b"snippet".hex().upper())
    assert rig.runner.queued == 0
    rig.modem.write("CARXP", 1)
    rig.modem.write("CARXD", 1, 3, 0, 1, "00FF")
    rig.modem.write("CACST", 8, 0)
    eventually(lambda: rig.of(PacketReceived))
    assert [event.data for event in rig.of(FrameReceived)] == [b"\x00\xff"]
    with pytest.raises(FrameError):
        rig.runner.send_packet(1, 9, [b"x"])


def test_packets_of_several_threads_are_all_sent(rig):
    eventually(lambda: rig.runner.ready)
    ids: list[int] = []

    def sender(number):
        for n in range(4):
            eventually(lambda: rig.runner.queued <= 4)
            ids.append(rig.runner.send_packet(1, 4, [bytes([number, n])]))

    threads = [threading.Thread(target=sender, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    eventually(lambda: len(rig.of(PacketSent, PacketFailed)) == 16)
    assert sorted(event.packet_id for event in rig.of(PacketSent)) == sorted(ids)
    assert len(set(ids)) == 16


def test_a_port_lost_during_a_cycle_is_opened_again(rig):
    eventually(lambda: rig.runner.ready)
    rig.modem.replies = False
    first, second = rig.runner.send_packet(1, 4, [b"first"]), rig.runner.send_packet(1, 4, [b"second"])
    eventually(lambda: any(s.kind == "CCCYC" for s in rig.modem.commands))
    rig.modem.unplug()
    eventually(lambda: rig.of(PacketFailed))
    (failed,) = rig.of(PacketFailed)
    assert (failed.packet_id, failed.reason) == (first, FailureReason.PORT_LOST)
    assert not rig.runner.ready
    rig.modem.replies = True
    rig.modem.plug()
    eventually(lambda: rig.of(PacketSent))
    assert [event.packet_id for event in rig.of(PacketSent)] == [second]
    assert len(rig.of(ModemReady)) == 2


def test_the_callback_may_send_and_may_raise(tmp_path, caplog):
    modem = PtyModem(tmp_path / "ttyMODEM")
    sent: list[int] = []

    def fail():
        raise RuntimeError("defect of a consumer")

    def on_event(event):
        if isinstance(event, ModemReady):
            runner.send_packet(1, 4, [b"from the callback"])
            fail()
        if isinstance(event, PacketSent):
            sent.append(event.packet_id)

    runner = ModemRunner(MicroModem(CONFIG), SerialPort(str(modem.path)), on_event)
    with caplog.at_level(logging.ERROR):
        runner.start()
        eventually(lambda: sent)
    runner.stop()
    modem.unplug()
    (record,) = caplog.records
    assert (record.getMessage(), record.fields["event"]) == ("Modem event not handled", "ModemReady")


def test_stop_reports_the_packet_that_failed(tmp_path):
    modem = PtyModem(tmp_path / "ttyMODEM")
    rig = Rig(modem)
    rig.runner.start()
    with pytest.raises(PortError, match="already started"):
        rig.runner.start()
    eventually(lambda: rig.runner.ready)
    modem.replies = False
    packet_id = rig.runner.send_packet(1, 4, [b"x"])
    eventually(lambda: any(s.kind == "CCCYC" for s in modem.commands))
    rig.runner.stop()
    assert [(event.packet_id, event.reason) for event in rig.of(PacketFailed)] == [(packet_id, FailureReason.PORT_LOST)]
    assert not any(thread.name.endswith("ttyMODEM") for thread in threading.enumerate())
    rig.runner.stop()
    modem.unplug()


def test_timers_run_without_a_byte_from_the_port(tmp_path, monkeypatch):
    """With a clock fifty times faster, a command without a reply is repeated."""
    monkeypatch.setattr(modem_runner, "time", SimpleNamespace(monotonic=lambda: 50.0 * time.monotonic()))
    monkeypatch.setattr(modem_runner, "_MAX_WAIT_S", 0.02)
    modem = PtyModem(tmp_path / "ttyMODEM")
    modem.replies = False
    events: list[ModemEvent] = []
    runner = ModemRunner(MicroModem(CONFIG), SerialPort(str(modem.path)), events.append)
    runner.start()
    eventually(lambda: events)
    runner.stop()
    modem.unplug()
    assert [s.fields for s in modem.commands[:3]] == [("SRC", "3")] * 3
    assert events[0].attempts == 3


def test_two_runners_ping_and_poll(tmp_path):
    modems = (ModemSite(address=1), ModemSite(address=2, east_m=150.0))
    channel = ChannelEmulator(EmulatorConfig(modem=modems, pty_dir=tmp_path / "modems", time_scale=150.0))
    channel.start()
    events: dict[int, list[ModemEvent]] = {1: [], 2: []}
    runners = {
        device.address: ModemRunner(
            MicroModem(MicroModemConfig(device.address)), SerialPort(device.device), events[device.address].append
        )
        for device in channel.devices()
    }
    try:
        for runner in runners.values():
            runner.start()
        runners[2].set_poll_handler(lambda polled: [b"polled"])
        eventually(lambda: all(runner.ready for runner in runners.values()))
        requests = [
            runners[1].request(lambda driver, now: driver.ping(2, now)),
            runners[1].request_packet(2, 1),
        ]
        eventually(lambda: len([e for e in events[1] if isinstance(e, RequestDone)]) == len(requests))
        assert [e.request_id for e in events[1] if isinstance(e, RequestDone)] == requests
        assert [e.travel_s for e in events[1] if isinstance(e, RangeMeasured)] == [0.1]
        assert [e.data for e in events[1] if isinstance(e, FrameReceived)] == [b"polled"]
        with pytest.raises(FrameError):
            runners[1].request(lambda driver, now: driver.ping(200, now))
    finally:
        for runner in runners.values():
            runner.stop()
        channel.stop()


class FragileModem(UdpModem):
    def receive(self, data, now):
        if data == b"defect":
            raise RuntimeError("a defect")
        return super().receive(data, now)


class FragilePort(ModemPort):
    """A port that fails once, then delivers what is put into `parts`."""

    STREAM = False

    def __init__(self):
        super().__init__("test port")
        self.parts = queue.SimpleQueue()
        self.opened = 0

    def write(self, data):
        pass

    def _run(self, on_event, closing):
        self.opened += 1
        if self.opened == 1:
            raise TypeError("of a library")
        on_event(PortOpened())
        while (part := self.parts.get()) is not None:
            on_event(part)
        closing.wait()


def test_defects_of_driver_and_port_cost_one_input(caplog):
    port, events = FragilePort(), []
    runner = ModemRunner(FragileModem(ModemSettings(1)), port, events.append)
    runner.start()
    datagram = Datagram(DatagramKind.DATA, 2, 255, 1, 7, (b"x",)).pack()
    for part in (*[b"junk"] * (2 * MAX_INPUTS), b"defect", datagram, None):
        port.parts.put(part)
    eventually(lambda: any(isinstance(event, PacketReceived) for event in events))
    runner.stop()
    assert (runner.failures, port.opened) == (1, 2)
    assert sum(isinstance(event, SentenceRejected) for event in events) == 2 * MAX_INPUTS
