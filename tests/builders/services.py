"""Shared by the tests of services: peer services, start and stop, monitoring, serial cables and emulated modems."""

import os
import select
import threading
import tty
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from builders.common import eventually, publish_once
from sonarpost import keys, wire
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Contact, Health, Pixels, Snippet
from sonarpost.runtime.service import Service, UnitOfWork

SIMULATION = "sonarpost.extensions.simulation"
"""Tests that use it are skipped without that extension."""

PlatformMaker = Callable[[str], PlatformConfig]


class PeerService(Service[ServiceConfig]):
    """Replaces the service before or after the one under test, with the same durable delivery."""

    NAME = "neighbour"

    def __init__(self, platform, consumed):
        super().__init__(platform, ServiceConfig())
        self._consumed = consumed
        self.received: list[Any] = []

    def consumed_keys(self):
        return self._consumed

    def handle(self, key, record, effects):
        self.received.append(record)

    def send(self, key, consumer, *records, priority=4):
        effects = UnitOfWork()
        for record in records:
            effects.send(key, consumer, record, priority=priority)
        self.commit(effects)

    def send_bytes(self, key, consumer, payload):
        """Send a payload that is not a record."""
        with self.store.transaction() as tx:
            tx.send(key, consumer, payload, encoding="")


@pytest.fixture(autouse=True)
def short_retry_delays(monkeypatch):
    """Shorten the delays before retries; these tests count retries, not seconds."""
    monkeypatch.setattr("sonarpost.runtime.record_handler.RETRY_AFTER_S", 0.05)
    monkeypatch.setattr("sonarpost.services.atd_stub.release.RELEASE_INTERVAL_S", 0.05)
    monkeypatch.setattr("sonarpost.services.op_modem.service.SAVE_RETRY_S", 0.05)
    monkeypatch.setattr("sonarpost.services.op_modem.service.TICK_S", 0.03)
    monkeypatch.setattr("sonarpost.services.uuv_modem.service._STATE_INTERVAL_S", 0.05)
    monkeypatch.setattr("sonarpost.services.uuv_modem.service.SAVE_AGAIN_S", 0.05)


class ServiceRunner:
    """Starts the services of one test and stops those that still run at its end."""

    def __init__(self, platform):
        self._platform = platform
        self._running: list[Service[Any]] = []

    def start(self, service):
        self._running.append(service)  # stopped at the end also if its start fails
        assert service.start()
        return service

    def stop(self, service):
        self._running.remove(service)
        service.stop()

    def peer(self, platform_id, name, consumed=None):
        named = type("Named", (PeerService,), {"NAME": name})
        return self.start(named(self._platform(platform_id), consumed or {}))

    def stop_all(self):
        """Stop all services at the same time, as a platform that is switched off does."""
        running, self._running = self._running, []
        with ThreadPoolExecutor() as pool:
            for stopped in [pool.submit(service.stop) for service in running]:
                stopped.result()


@pytest.fixture
def runner(platform):
    runner = ServiceRunner(platform)
    yield runner
    runner.stop_all()


@pytest.fixture
def check_monitoring(client, runner):
    """Check liveliness token and health records of a running service, then stop it and check the last ones."""

    def tokens(key):
        return [str(reply.ok.key_expr) for reply in client.liveliness().get(key, timeout=60.0) if reply.ok]

    def check(service):
        key = keys.alive(service.platform.id, service.NAME)
        eventually(lambda: tokens(key) == [key], what=f"token {key}")
        health_records: list[Health] = []
        subscriber = client.declare_subscriber(
            keys.health_all(service.platform.id),
            lambda sample: health_records.append(wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr))),
        )
        eventually(lambda: any(h.service == service.NAME for h in health_records), what="health record")
        runner.stop(service)
        eventually(lambda: tokens(key) == [], what=f"end of token {key}")
        eventually(
            lambda: "stopping" in [h.state for h in health_records if h.service == service.NAME],
            what="last health record",
        )
        subscriber.undeclare()

    return check


@pytest.fixture
def refused():
    """Return what a service has quarantined: (key, reason), oldest first."""

    def read(service):
        return [(str(k), str(r)) for k, r in service.store._query("SELECT key, reason FROM refused ORDER BY id")]

    return read


@contextmanager
def _pragma(service, during, after):
    with service.store._lock:
        service.store._db.execute(f"PRAGMA {during}")
    yield
    with service.store._lock:
        service.store._db.execute(f"PRAGMA {after}")


@pytest.fixture
def full_disk():
    """Let the store of a service grow no further."""
    return lambda service: _pragma(service, "max_page_count=1", "max_page_count=1000000")


@pytest.fixture
def unwritable():
    """Make every write to the store of a service fail."""
    return lambda service: _pragma(service, "query_only=ON", "query_only=OFF")


@pytest.fixture
def publish(client):
    """Publish without an outbox, as soon as a subscriber exists."""
    return partial(publish_once, client)


@pytest.fixture
def watch(client):
    """Collect what is published on a key."""

    def collect(key):
        samples: list[zenoh.Sample] = []
        client.declare_subscriber(key, samples.append)
        return samples

    return collect


@pytest.fixture(scope="session")
def survey_bytes(tmp_path_factory):
    """Make the bytes of a small XTF survey with contacts; the same seed gives the same bytes."""
    folder = tmp_path_factory.mktemp("xtf")
    made: dict[int, bytes] = {}

    def make(seed):
        if seed not in made:
            path = folder / f"{seed}.xtf"
            simulator = pytest.importorskip(f"{SIMULATION}.seabed.survey")
            spec = simulator.SurveySpec(seed=seed, pings=200, samples=512)
            import_module(f"{SIMULATION}.seabed.xtf_writer").write_xtf(simulator.simulate_survey(spec).survey, path)
            made[seed] = path.read_bytes()
        return made[seed]

    return make


@pytest.fixture(scope="session")
def texture():
    """Make an image with structure."""

    def make(height_px=40, width_px=60, seed=1, dtype=np.uint8):
        rng = np.random.default_rng(seed)
        coarse = rng.integers(0, 200, (height_px // 8 + 1, width_px // 8 + 1))
        fine = np.kron(coarse, np.ones((8, 8)))[:height_px, :width_px] + rng.integers(0, 55, (height_px, width_px))
        return (fine if dtype == np.uint8 else fine * 200).astype(dtype)

    return make


@pytest.fixture(scope="session")
def snippet(texture):
    """Make a snippet by its contact identifier."""

    def make(contact_id, height_px=40, width_px=60, **options):
        pixels = Pixels.from_array(texture(height_px, width_px, **options))
        return Snippet(contact=Contact(contact_id=contact_id, vehicle_id="uuv-1"), pixels=pixels)

    return make


@pytest.fixture
def put_file(tmp_path):
    """Put a complete file into the polled folder: written under a hidden name, then renamed."""
    folder = tmp_path / "incoming"
    folder.mkdir(exist_ok=True)

    def put(name, data):
        hidden = folder / f".{name}.part"
        hidden.write_bytes(data)
        return hidden.rename(folder / name)

    return put


class SerialCable:
    """A pseudo-terminal between a service and an emulated modem, into which a test can write.

    Args:
        device: Port of the emulated modem, or None for a cable that is connected to nothing.
        port: Path of the service's end; a link, because another program can get the name of a closed terminal.
    """

    def __init__(self, device, port):
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        port.symlink_to(os.ttyname(self._slave))
        self.port = str(port)
        self._modem = -1
        if device is not None:
            self._modem = os.open(device, os.O_RDWR | os.O_NOCTTY)
            tty.setraw(self._modem)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._copy, daemon=True)
        self._thread.start()

    def say(self, data):
        """Send bytes to the service."""
        while data:
            data = data[os.write(self._master, data) :]

    def _copy(self):
        ends = {self._master: self._modem, self._modem: self._master}
        ends.pop(-1, None)
        while not self._stop.is_set():
            for end in select.select(list(ends), [], [], 0.05)[0]:
                data = os.read(end, 4096)
                if ends[end] >= 0:
                    os.write(ends[end], data)

    def close(self):
        Path(self.port).unlink()
        self._stop.set()
        self._thread.join()
        for descriptor in (self._master, self._slave, self._modem):
            if descriptor >= 0:
                os.close(descriptor)


@pytest.fixture
def serial_cable(tmp_path):
    """Make serial cables."""
    made: list[SerialCable] = []

    def make(device):
        made.append(SerialCable(device, tmp_path / f"cable-{len(made)}"))
        return made[-1]

    yield make
    for each in made:
        each.close()


class ModemPair:
    """Two emulated modems, the vessel's (1) and the vehicle's (3), 150 m apart, on accelerated time."""

    VESSEL, VEHICLE = 1, 2

    def __init__(self, folder):
        self.folder = folder
        self._channel: Any = None

    def port(self, modem):
        return str(self.folder / f"modem-{modem}")

    def start(self, *, time_scale=150.0, echo=None, **channel):
        config = pytest.importorskip(f"{SIMULATION}.channel.config")
        modems = (config.ModemSite(address=1), config.ModemSite(address=3, east_m=150.0))
        settings = config.EmulatorConfig(modem=modems, **channel, pty_dir=self.folder, time_scale=time_scale)
        self._channel = import_module(f"{SIMULATION}.channel.emulator").ChannelEmulator(settings, echo)
        self._channel.start()
        return self._channel

    def stop(self):
        if self._channel is not None:
            self._channel.stop()
            self._channel = None


@pytest.fixture
def modem_pair(tmp_path):
    modem_pair = ModemPair(tmp_path / "modems")
    yield modem_pair
    modem_pair.stop()
