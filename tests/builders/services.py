"""What the tests of services share: neighbours that owe and take records, starting, stopping, and being watched."""

from __future__ import annotations

import os
import select
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from builders.common import eventually, publish_once
from sonarpost import keys, wire
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Contact, Health, Pixels, Record, Snippet
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.channel_config import ChannelParameters
from sonarpost.simulation.channel.emulator import ChannelEmulator
from sonarpost.simulation.channel.emulator_config import EmulatorConfig, ModemSite
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.xtf_writer import write_xtf

PlatformMaker = Callable[[str], PlatformConfig]


class Neighbour(Service[ServiceConfig]):
    """Stands in for the service before or behind the one under test, with the same durable hand-off."""

    NAME = "neighbour"

    def __init__(self, platform: PlatformConfig, takes: Mapping[str, type[Record]]) -> None:
        super().__init__(platform, ServiceConfig())
        self._takes = takes
        self.got: list[Any] = []

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return self._takes

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        self.got.append(record)

    def owe(self, key: str, consumer: str, *records: Record, priority: int = 4) -> None:
        effects = UnitOfWork()
        for record in records:
            effects.send(key, consumer, record, priority=priority)
        self.commit(effects)

    def owe_bytes(self, key: str, consumer: str, payload: bytes) -> None:
        """Owe something that is no record."""
        with self.store.transaction() as tx:
            tx.send(key, consumer, payload, encoding="")


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waits before another attempt are shortened; they are counted in tries, never in seconds, here."""
    monkeypatch.setattr("sonarpost.runtime.service.RETRY_AFTER_S", 0.05)
    monkeypatch.setattr("sonarpost.services.decompressor.service.RETRY_AFTER_S", 0.05)
    monkeypatch.setattr("sonarpost.services.decompressor.service.QUIET_S", 0.05)
    monkeypatch.setattr("sonarpost.services.op_modem.service.SAVE_AGAIN_S", 0.05)


class Crew:
    """The services of one test; whatever still runs at its end is stopped."""

    def __init__(self, platform: PlatformMaker) -> None:
        self._platform = platform
        self._running: list[Service[Any]] = []

    def start(self, service: Service[Any]) -> Any:
        assert service.start()
        self._running.append(service)
        return service

    def stop(self, service: Service[Any]) -> None:
        self._running.remove(service)
        service.stop()

    def neighbour(self, platform_id: str, name: str, takes: Mapping[str, type[Record]] | None = None) -> Neighbour:
        named = type("Named", (Neighbour,), {"NAME": name})
        return self.start(named(self._platform(platform_id), takes or {}))

    def stop_all(self) -> None:
        """Stop all at once, as a platform that is switched off does, and as quickly."""
        running, self._running = self._running, []
        with ThreadPoolExecutor() as pool:
            for stopped in [pool.submit(service.stop) for service in running]:
                stopped.result()


@pytest.fixture
def crew(platform: PlatformMaker) -> Iterator[Crew]:
    crew = Crew(platform)
    yield crew
    crew.stop_all()


@pytest.fixture
def is_told(client: zenoh.Session, crew: Crew) -> Callable[[Service[Any]], None]:
    """Checks a running service's liveliness token and health record, and that the token ends with it."""

    def tokens(key: str) -> list[str]:
        return [str(reply.ok.key_expr) for reply in client.liveliness().get(key, timeout=5.0) if reply.ok]

    def check(service: Service[Any]) -> None:
        key = keys.alive(service.platform.id, service.NAME)
        eventually(lambda: tokens(key) == [key], what=f"token {key}")
        heard: list[Health] = []
        subscriber = client.declare_subscriber(
            keys.health_all(service.platform.id),
            lambda sample: heard.append(wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr))),
        )
        eventually(lambda: any(h.service == service.NAME for h in heard), what="health record")
        crew.stop(service)
        eventually(lambda: tokens(key) == [], what=f"end of token {key}")
        eventually(
            lambda: "stopping" in [h.state for h in heard if h.service == service.NAME], what="last health record"
        )
        subscriber.undeclare()

    return check


@pytest.fixture
def refused() -> Callable[[Service[Any]], list[tuple[str, str]]]:
    """Reads what a service keeps apart: (key, reason), oldest first."""

    def read(service: Service[Any]) -> list[tuple[str, str]]:
        return [(str(k), str(r)) for k, r in service.store._query("SELECT key, reason FROM refused ORDER BY id")]

    return read


@pytest.fixture
def publish(client: zenoh.Session) -> Callable[[str, bytes], None]:
    """Publishes as a program without an outbox does, once somebody listens."""
    return partial(publish_once, client)


@pytest.fixture
def watch(client: zenoh.Session) -> Callable[[str], list[zenoh.Sample]]:
    """Collects what is published on a key, as a plain subscriber."""

    def collect(key: str) -> list[zenoh.Sample]:
        samples: list[zenoh.Sample] = []
        client.declare_subscriber(key, samples.append)
        return samples

    return collect


@pytest.fixture(scope="session")
def xtf(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], bytes]:
    """Small surveys with contacts in them, as bytes of XTF files; the same seed gives the same bytes."""
    folder = tmp_path_factory.mktemp("xtf")
    made: dict[int, bytes] = {}

    def make(seed: int) -> bytes:
        if seed not in made:
            path = folder / f"{seed}.xtf"
            write_xtf(simulate_survey(SurveySpec(seed=seed, pings=200, samples=512)).survey, path)
            made[seed] = path.read_bytes()
        return made[seed]

    return make


@pytest.fixture(scope="session")
def texture() -> Callable[..., np.ndarray]:
    """Pictures with something in them."""

    def make(height_px: int = 40, width_px: int = 60, seed: int = 1, dtype: type = np.uint8) -> np.ndarray:
        rng = np.random.default_rng(seed)
        coarse = rng.integers(0, 200, (height_px // 8 + 1, width_px // 8 + 1))
        fine = np.kron(coarse, np.ones((8, 8)))[:height_px, :width_px] + rng.integers(0, 55, (height_px, width_px))
        return (fine if dtype == np.uint8 else fine * 200).astype(dtype)

    return make


@pytest.fixture(scope="session")
def snippet(texture: Callable[..., np.ndarray]) -> Callable[..., Snippet]:
    """Snippets by name."""

    def make(contact_id: str, height_px: int = 40, width_px: int = 60, **options: Any) -> Snippet:
        picture = Pixels.from_array(texture(height_px, width_px, **options))
        return Snippet(contact=Contact(contact_id=contact_id, vehicle_id="uuv-1"), picture=picture)

    return make


@pytest.fixture
def put_file(tmp_path: Path) -> Callable[[str, bytes], Path]:
    """Puts a whole file into the folder that is polled, as a copy under a hidden name and a rename do."""
    folder = tmp_path / "incoming"
    folder.mkdir()

    def put(name: str, data: bytes) -> Path:
        hidden = folder / f".{name}.part"
        hidden.write_bytes(data)
        return hidden.rename(folder / name)

    return put


class SerialCable:
    """A pseudo-terminal between a service and an emulated modem, into which a test can speak.

    Args:
        device: The emulated modem's port, or None for a cable with nothing at its end.
    """

    def __init__(self, device: str | None) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._modem = -1
        if device is not None:
            self._modem = os.open(device, os.O_RDWR | os.O_NOCTTY)
            tty.setraw(self._modem)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._copy, daemon=True)
        self._thread.start()

    def say(self, data: bytes) -> None:
        """Let the service read these bytes."""
        while data:
            data = data[os.write(self._master, data) :]

    def _copy(self) -> None:
        ends = {self._master: self._modem, self._modem: self._master}
        ends.pop(-1, None)
        while not self._stop.is_set():
            for end in select.select(list(ends), [], [], 0.05)[0]:
                data = os.read(end, 4096)
                if ends[end] >= 0:
                    os.write(ends[end], data)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for descriptor in (self._master, self._slave, self._modem):
            if descriptor >= 0:
                os.close(descriptor)


@pytest.fixture
def cable() -> Iterator[Callable[[str | None], SerialCable]]:
    """Lays serial cables."""
    laid: list[SerialCable] = []

    def lay(device: str | None) -> SerialCable:
        laid.append(SerialCable(device))
        return laid[-1]

    yield lay
    for each in laid:
        each.close()


class Sea:
    """Two emulated modems, the vessel's (1) and the vehicle's (3), 150 m apart, where time runs fast."""

    VESSEL, VEHICLE = 1, 2

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._channel: ChannelEmulator | None = None

    def port(self, modem: int) -> str:
        return str(self.folder / f"modem-{modem}")

    def start(self, **water: Any) -> ChannelEmulator:
        sites = (ModemSite(1), ModemSite(3, LocalPosition(150.0)))
        config = EmulatorConfig(sites, ChannelParameters(**water), pty_dir=self.folder, time_scale=150.0)
        self._channel = ChannelEmulator(config)
        self._channel.start()
        return self._channel

    def stop(self) -> None:
        if self._channel is not None:
            self._channel.stop()
            self._channel = None


@pytest.fixture
def sea(tmp_path: Path) -> Iterator[Sea]:
    sea = Sea(tmp_path / "modems")
    yield sea
    sea.stop()
