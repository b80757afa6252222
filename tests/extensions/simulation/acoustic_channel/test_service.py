"""The channel emulator on pseudo-terminals and TCP ports: library, command and service."""

import hashlib
import json
import runpy
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import serial
from builders.common import WAIT_S, eventually, free_port
from pydantic import ValidationError

from sonarpost import keys, wire
from sonarpost.cli.deployment.config_files import example_files
from sonarpost.cli.main import main, parser
from sonarpost.errors import ConfigError, PortError
from sonarpost.extensions.simulation.acoustic_channel.config import AcousticChannelConfig
from sonarpost.extensions.simulation.acoustic_channel.service import AcousticChannelService
from sonarpost.extensions.simulation.channel.config import EmulatorConfig, ModemSite
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.messages import Health
from sonarpost.modem.micromodem import nmea

MODEMS = (ModemSite(address=1), ModemSite(address=2, east_m=150.0))
SCALE = 100.0


class Host:
    """A client of one modem that fills cycles and collects the received sentences."""

    def __init__(self, device):
        self._port = serial.serial_for_url(device, timeout=0)
        self._lines = nmea.LineAssembler(device)
        self.sentences: list[nmea.Sentence] = []
        self._query_until_answered()

    def _query_until_answered(self):
        def answered():
            self.send_sentence("CCCFQ", "SRC")
            self.wait(0.02)
            return any(sentence.kind == "CACFG" for sentence in self.sentences)

        eventually(answered, what="answer to CCCFQ")

    def send_sentence(self, kind, *fields):
        self._port.write(nmea.format(kind, *fields))

    def write(self, data):
        self._port.write(data)

    def read(self):
        for item in self._lines.feed(self._port.read(65536)):
            assert isinstance(item, nmea.Sentence), item
            self.sentences.append(item)

    def wait(self, wait_s):
        select.select([self._port], [], [], wait_s)
        self.read()

    def count(self, kind):
        return sum(sentence.kind == kind for sentence in self.sentences)

    def expect(self, kind, number=1):
        def arrived():
            self.wait(0.02)
            return self.count(kind) >= number

        eventually(arrived, what=f"{number} x {kind}")

    def send(self, destination, rate, frames, source=1):
        """Run a cycle to the end of its transmission."""
        sent, requests = self.count("CAXST"), self.count("CADRQ")
        self.send_sentence("CCCYC", 0, source, destination, rate, 0, len(frames))
        for number, frame in enumerate(frames, start=1):
            self.expect("CADRQ", requests + number)
            self.send_sentence("CCTXD", source, destination, 0, frame.hex())
        self.expect("CAXST", sent + 1)

    def received(self):
        """Frame number and bytes of every `CARXD`."""
        return [(int(s.fields[3]), bytes.fromhex(s.fields[4])) for s in self.sentences if s.kind == "CARXD"]

    def close(self):
        self._port.close()


Make = Callable[..., ChannelEmulator]


@pytest.fixture
def make(tmp_path):
    """Start emulators, by default with pseudo-terminals and a log in a temporary folder, and stop them."""
    running: list[ChannelEmulator] = []

    def start(**config):
        defaults: dict[str, object] = {"modem": MODEMS, "time_scale": SCALE, "log": tmp_path / "channel.jsonl"}
        if "tcp_ports" not in config:
            defaults["pty_dir"] = tmp_path / "ports"
        emulator = ChannelEmulator(EmulatorConfig(**(defaults | config)))  # type: ignore[arg-type]
        running.append(emulator)
        emulator.start()
        return emulator

    yield start
    for emulator in running:
        emulator.stop()
        assert emulator.failure is None


def log_of(path, event=None):
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return [line for line in lines if event is None or line["event"] == event]


def hosts_of(emulator):
    return [Host(device.device) for device in emulator.devices()]


@pytest.mark.parametrize("tcp", [False, True])
def test_log_matches_the_received_sentences_and_one_seed_gives_equal_outcomes(make, tmp_path, tcp):
    outcomes = []
    for name in ("first.jsonl", "channel.jsonl"):
        ports = {"tcp_ports": (0, 0)} if tcp else {}
        emulator = make(seed=3, frame_loss=0.3, tail_damage=0.4, log=tmp_path / name, **ports)
        sender, receiver = hosts_of(emulator)
        for n in range(12):
            sender.send(2, 5, [bytes([n, k]) * 20 for k in range(3)] + [b""])
            receiver.expect("CACST", n + 1)
        sender.close()
        receiver.close()
        emulator.stop()
        outcomes.append([p["frames"] for p in log_of(tmp_path / name, "packet")])
    assert outcomes[0] == outcomes[1]

    packets = log_of(tmp_path / "channel.jsonl", "packet")
    assert [p["packet"] for p in packets] == list(range(1, 13))
    assert all(
        p["heard"] and (p["source"], p["destination"], p["receiver"], p["rate"]) == (1, 2, 2, 5) for p in packets
    )
    frames = [frame for p in packets for frame in p["frames"]]
    received = [(f["number"], bytes.fromhex(f["hex"])) for f in frames if f["fate"] in {"delivered", "damaged"}]
    assert received == receiver.received()
    assert {f["fate"] for f in frames} == {"delivered", "lost", "damaged", "empty"}
    for frame in frames:
        data = bytes.fromhex(frame["hex"])
        assert (len(data), hashlib.sha256(data).hexdigest()) == (frame["bytes"], frame["sha256"])
        assert ("sent_hex" in frame) == (frame["fate"] == "damaged")
    lost = sum(f["fate"] == "lost" for f in frames)
    assert receiver.count("CAMSG") == lost

    start, *_, stop, totals = log_of(tmp_path / "channel.jsonl")
    assert (start["event"], stop["event"], totals["event"]) == ("start", "stop", "totals")
    assert start["water"]["seed"] == 3
    assert (totals["transmitted"], totals["heard"], totals["not_heard"], totals["in_flight"]) == (12, 12, {}, 0)
    assert totals["frames"] == {fate: sum(f["fate"] == fate for f in frames) for fate in totals["frames"]}


def test_packet_without_a_client_is_logged_as_not_heard(make, tmp_path):
    emulator = make()
    sender = Host(emulator.devices()[0].device)
    sender.send(2, 1, [b"abc"])
    eventually(lambda: emulator.totals().unreported == {"no client connected": 1}, what="packet in the totals")
    emulator.stop()
    (packet,) = log_of(tmp_path / "channel.jsonl", "packet")
    assert (packet["heard"], packet["not_heard_because"]) == (False, "no client connected")
    assert packet["frames"][0]["fate"] == "delivered"


@pytest.mark.parametrize("tcp", [False, True])
def test_reconnected_client_receives_no_stale_output(make, tcp):
    emulator = make(**({"tcp_ports": (0, 0)} if tcp else {}))
    sender, receiver = hosts_of(emulator)
    for n in range(3):
        # The receiver disconnects without reading the packet.
        sender.send(2, 1, [b"unread"])
        eventually(lambda n=n: emulator.totals().reported == n + 1, what="packet written to the port")
        receiver.close()
        eventually(lambda: emulator.connected() == 1, what="client seen to have left")
        receiver = Host(emulator.devices()[1].device)
        assert receiver.count("CARXD") == 0
    sender.send(2, 1, [b"fresh"])
    receiver.expect("CACST")
    assert receiver.received() == [(1, b"fresh")]


def test_restarted_emulator_has_the_same_paths(make, tmp_path):
    first = make()
    devices = [device.device for device in first.devices()]
    assert devices == [str(tmp_path / "ports" / f"modem-{n}") for n in (1, 2)]
    Host(devices[0]).close()
    first.stop()
    assert not any(Path(device).is_symlink() for device in devices)
    second = make()
    assert [device.device for device in second.devices()] == devices
    Host(devices[0]).close()
    # An emulator that has replaced the paths of another keeps them when the other stops.
    third = make()
    second.stop()
    Host(third.devices()[0].device).close()


def test_command_of_a_short_lived_client_is_processed(make):
    emulator = make()
    device = Path(emulator.devices()[0].device)
    with device.open("wb", buffering=0) as port:
        port.write(nmea.format("CCCFG", "SRC", 42))
    host = Host(str(device))
    assert {sentence.fields for sentence in host.sentences if sentence.kind == "CACFG"} == {("SRC", "42")}


def test_new_tcp_client_replaces_the_previous_one(make):
    emulator = make(tcp_ports=(0, 0))
    first = Host(emulator.devices()[0].device)
    second = Host(emulator.devices()[0].device)
    second.send_sentence("CCCFQ", "CST")
    second.expect("CACFG", 2)
    with pytest.raises(serial.SerialException):
        eventually(lambda: first.wait(0.05) is not None)


def test_client_that_does_not_read_loses_whole_sentences(make):
    emulator = make(tcp_ports=(0, 0))
    device = emulator.devices()[0].device
    with socket.create_connection(("127.0.0.1", int(device.rsplit(":", 1)[1]))) as idle:
        idle.settimeout(WAIT_S)
        for _ in range(100):  # some 5 MB of answers
            idle.sendall(nmea.format("CCCFQ", "ALL") * 50)
        assembler = nmea.LineAssembler()
        seen = 0
        while seen <= 1000:
            for item in assembler.feed(idle.recv(1 << 20)):
                assert isinstance(item, nmea.Sentence)
                seen += 1
    Host(emulator.devices()[1].device).close()


def test_air_time_is_scaled(make):
    """Unscaled, the end of the packet would be after the time-out of `expect`."""
    emulator = make(time_scale=400.0, airtime_s={1: 200.0})
    host = Host(emulator.devices()[0].device)
    host.send_sentence("CCCYC", 0, 1, 2, 1, 0, 1)
    host.expect("CADRQ")
    started_s = time.monotonic()
    host.send_sentence("CCTXD", 1, 2, 0, "AA")
    host.expect("CATXF")
    assert time.monotonic() - started_s >= 0.5


def test_port_error_names_the_port(make, tmp_path):
    (tmp_path / "ports").mkdir()
    (tmp_path / "ports" / "modem-2").write_text("not a link")
    with pytest.raises(PortError, match="modem-2"):
        make()
    assert not (tmp_path / "ports" / "modem-1").is_symlink()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(PortError, match=str(port)):
            make(tcp_ports=(0, port))
    with pytest.raises(PortError, match="log"):
        make(log=tmp_path, tcp_ports=(0, 0))


def test_log_that_cannot_be_written_ends_the_emulator(tmp_path):
    config = EmulatorConfig(modem=MODEMS, pty_dir=tmp_path / "ports", log=Path("/dev/full"))
    emulator = ChannelEmulator(config)
    emulator.start()
    eventually(lambda: emulator.failure is not None, what="failure")
    assert isinstance(emulator.failure, PortError)
    assert list((tmp_path / "ports").iterdir()) == []
    emulator.stop()


@pytest.mark.parametrize(
    "config", [{"modem": ({"address": 1}, {"address": 1})}, {"modem": ({"address": 200},)}, {"tcp_ports": (1,)}]
)
def test_invalid_configuration_is_rejected(config, tmp_path):
    complete = {"modem": MODEMS, "pty_dir": tmp_path} | config
    for table in (EmulatorConfig, AcousticChannelConfig):
        with pytest.raises(ValidationError, match=next(iter(config))):
            table.model_validate(complete)


# The command


def run_command(*arguments):
    code = (
        "import sys; from sonarpost.cli.main import parser;"
        "a = parser('modem-emulator').parse_args(sys.argv[1:]); sys.exit(a.run(a))"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code, "modem-emulator", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_command_lists_its_devices_first_and_ends_cleanly(tmp_path, ending):
    log, ports = tmp_path / "log.jsonl", tmp_path / "ports"
    options = ("--modems", "3", "--pty", str(ports), "--log", str(log), "--time-scale", "100", "--json")
    with run_command(*options) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        listed = json.loads(process.stdout.readline())
        assert listed == {"modems": [{"address": n, "device": str(ports / f"modem-{n}")} for n in (1, 2, 3)]}
        host = Host(listed["modems"][0]["device"])
        host.send(2, 1, [b"abc"])
        host.close()
        process.send_signal(ending)
        # communicate() would miss the output that readline has buffered.
        rest = process.stdout.read()
        assert (process.wait(timeout=WAIT_S), process.stderr.read()) == (0, "")
    assert rest == log.read_text(encoding="utf-8")
    assert log_of(log)[-1]["event"] == "totals"
    assert list(ports.iterdir()) == []


@pytest.mark.parametrize("arguments", [(), ("--json",)])
def test_command_with_tcp_ports_continues_when_its_output_is_closed(arguments):
    ports = [] if arguments else [free_port(), free_port()]  # free ones by default
    options = ("--tcp", *map(str, ports), "--mm", "1", "--time-scale", "100", *arguments)
    with run_command(*options) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        listed = json.loads(process.stdout.readline())
        if ports:
            assert [m["device"] for m in listed["modems"]] == [f"socket://127.0.0.1:{port}" for port in ports]
        process.stdout.close()
        host = Host(listed["modems"][0]["device"])
        host.send(2, 1, [b"abc"])
        host.expect("CATXF")
        eventually(lambda: (host.wait(0.05), "0.93.0.09" in str(host.sentences))[1], what="a Micro-Modem 1")
        host.close()
        assert process.poll() is None
        process.terminate()
        assert (process.wait(timeout=WAIT_S), process.stderr.read()) == (0, "")


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("--modems 0", "--modems"),
        ("--set colour=blue", "colour"),
        ("--transponder A=far", "--transponder"),
        ("--transponder E=1", "transponder.0.letter"),
        ("--loss 1.5", "frame_loss"),
        ("--modems 3 --tcp 1 2", "tcp_ports"),
        ("--airtime fast", "--airtime"),
        ("--airtime 9=1", "airtime_s"),
        ("--spacing nan", "east_m"),
    ],
)
def test_command_rejects_invalid_options(arguments, named):
    parsed = parser("modem-emulator").parse_args(["modem-emulator", *arguments.split()])
    with pytest.raises(ConfigError, match=named):
        parsed.run(parsed)


# The service


def test_the_example_configuration_is_valid(tmp_path, capsys):
    path = tmp_path / "sim.toml"
    path.write_text(example_files()["sim"].read_text().replace("/var/lib/sonarpost", str(tmp_path)))
    assert main(["config", "check", str(path)]) == 0
    assert "[acoustic_channel]: valid" in capsys.readouterr().out


def test_run_finds_the_service(monkeypatch):
    started = []
    monkeypatch.setattr(runpy, "run_module", lambda name, **_: started.append(name))
    monkeypatch.setattr(sys, "argv", ["sonarpost"])
    assert main(["run", "acoustic_channel", "--config", "sim.toml"]) == 0
    assert started == ["sonarpost.extensions.simulation.acoustic_channel"]


def test_service_provides_modems_and_publishes_gauges(platform, client, tmp_path):
    config = AcousticChannelConfig(
        pty_dir=tmp_path / "ports", log=tmp_path / "channel.jsonl", time_scale=SCALE, airtime_s={"1": 2.0}
    )
    service = AcousticChannelService(platform("sea"), config)
    reports: list[Health] = []
    key = keys.health("sea", "acoustic_channel")
    subscriber = client.declare_subscriber(
        key, lambda sample: reports.append(wire.decode(Health, sample.payload.to_bytes(), key))
    )
    try:
        assert service.start()
        sender, receiver = (Host(str(tmp_path / "ports" / f"modem-{n}")) for n in (1, 2))
        sender.send(2, 1, [b"abc"])
        receiver.expect("CACST")

        def reported():
            return any(r.gauges.get("frames_delivered") == 1 and r.gauges["modems_connected"] == 2 for r in reports)

        eventually(reported, what="health with one delivered frame")
        sender.close()
        receiver.close()
    finally:
        service.stop()
        subscriber.undeclare()
    assert log_of(tmp_path / "channel.jsonl")[-1]["frames"]["delivered"] == 1
    assert log_of(tmp_path / "channel.jsonl", "packet")[0]["airtime_s"] == 2.0
