"""A shore site in real processes, a vessel's compressor and detector, hostile sources, and sources that are measured.

Vessels, the console and observers have sessions with certificates. The services are processes of their own, in
containers with a memory limit if SONARPOST_HOSTILE_CONTAINER names an image, with SONARPOST_HOSTILE_WORKERS decoding
processes (docs/research/faults.md).
"""

import json
import os
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from http.client import HTTPException
from importlib import import_module
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import zenoh

from builders.common import REPOSITORY, WAIT_S, eventually, free_port
from builders.extensions import modules
from builders.fleet_certificates import World
from sonarpost import keys, wire
from sonarpost.bus.session import client_config
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.delivery.outbox import Outbox
from sonarpost.delivery.queue_sender import QueuePolicy
from sonarpost.delivery.store import Store
from sonarpost.messages import Contact, Health, ImagePart, Pixels, Snippet
from sonarpost.services.console.store.users import Users
from sonarpost.stop_signals import EXIT_WITH_PARENT

VESSEL, HOSTILE = "vessel-1", "vessel-2"
PASSWORD = "correct horse battery"
USERS = {"eva": "expert", "ben": "observer"}
"""eva is measured, ben is hostile."""
MEMORY_BYTES = 512 * 1024 * 1024
"""Limit of docker-compose.yml and packaging/kubernetes for each service."""


def coded_part(number: int, side_px: int = 48) -> ImagePart:
    """Return a coded image; each number gives other pixels."""
    pixels = np.random.default_rng(number).integers(0, 256, (side_px, side_px), dtype=np.uint8)
    stream = default_registry().create("emb", CodecResources(strength=0.0)).encode(pixels, 200)
    return ImagePart(u="uuv-1", i=f"{number:04d}", n=1, t=1_700_000_000.0 + number, p=stream)


class Sender:
    """Outbox of one source; `send` queues payloads for a consumer."""

    def __init__(self, session: zenoh.Session, path: Path) -> None:
        self._store = Store(path)
        self._outbox = Outbox(session, self._store, queue_policy=lambda _: QueuePolicy(publish=False))

    def send(self, key: str, consumer: str, payloads: Sequence[bytes]) -> None:
        with self._store.transaction() as tx:
            for payload in payloads:
                tx.send(key, consumer, payload, encoding="", priority=5)

    def close(self) -> None:
        self._outbox.close()
        self._store.close()


class Arrivals:
    """Times at which records with an identity were published on a key."""

    def __init__(self, session: zenoh.Session, key: str, name: str) -> None:
        self.at_s: dict[str, float] = {}
        self._name = name
        session.declare_subscriber(key, self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        fields = msgpack.unpackb(sample.payload.to_bytes(), strict_map_key=False)
        self.at_s.setdefault(str(fields[self._name]), time.monotonic())

    def delays_s(self, sent_s: dict[str, float]) -> list[float]:
        """Wait for all records; return their delays."""
        eventually(lambda: sent_s.keys() <= self.at_s.keys(), what=f"{len(sent_s)} records")
        return [self.at_s[name] - sent_s[name] for name in sent_s]


@dataclass
class Process:
    """A service: its process on this host, which can be the client of a container."""

    name: str
    popen: subprocess.Popen[bytes]
    log: Path
    container: str = ""
    pid: int = 0
    """Process in the container, as this host numbers it."""
    peak_bytes: int = 0

    def pids(self) -> list[int]:
        """Return the process and its descendants."""
        found = [self.pid or self.popen.pid]
        for pid in found:
            try:
                tasks = list(Path(f"/proc/{pid}/task").iterdir())
                found += [int(child) for task in tasks for child in (task / "children").read_text().split()]
            except (FileNotFoundError, ProcessLookupError):
                continue
        return found

    def measure(self) -> None:
        """Update the peak of the memory of all its processes, shared pages in equal parts."""
        total = 0
        for pid in self.pids():
            try:
                lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
            except (OSError, ProcessLookupError):
                continue
            total += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))
        self.peak_bytes = max(self.peak_bytes, total)


@dataclass
class Site:
    """The running services, hostile sources, and those that are measured."""

    folder: Path
    world: World
    router: str
    local: str
    decode_workers: int = 1
    processes: dict[str, Process] = field(default_factory=dict)
    health: dict[str, Health] = field(default_factory=dict)
    added: dict[str, Any] = field(default_factory=dict)
    """What the attacks of extensions keep."""
    _stack: ExitStack = field(default_factory=ExitStack)
    _senders: dict[str, Sender] = field(default_factory=dict)
    _number: int = 0

    def __post_init__(self) -> None:
        self.console_port = free_port()
        self.console_url = f"http://127.0.0.1:{self.console_port}"
        self.incoming = self.folder / "incoming"
        self.session = self.keep(zenoh.open(client_config([self.local])))
        self.images = Arrivals(self.session, keys.shore_image(VESSEL), "image_id")
        self.decisions = Arrivals(self.session, keys.shore_decision(VESSEL), "decision_id")
        self.session.declare_subscriber(keys.health_everywhere(), self._on_health)

    def _on_health(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        platform, service = keys.service_of(key)
        if (platform, service) in {
            ("shore-1", "c2"),
            ("shore-1", "console"),
            ("uuv-1", "compressor"),
            ("uuv-2", "atd_stub"),
        }:
            self.health[service] = wire.decode(Health, sample.payload.to_bytes(), key)

    def keep(self, session: zenoh.Session) -> zenoh.Session:
        self._stack.callback(session.close)
        return session

    def opened(self, name: str) -> zenoh.Session:
        """Open a session with a certificate; it is closed with the site."""
        return self.keep(self.world.open(name, endpoint=self.router))

    def sender(self, name: str) -> Sender:
        """Return the outbox of a certificate; "" for a program of the site, "uuv-1" for one of the vehicle."""
        if name not in self._senders:
            session = self.opened(name) if name.startswith(("vessel", "console")) else self.session
            self._senders[name] = Sender(session, self.folder / f"{name or 'local'}.db")
        return self._senders[name]

    # Processes

    def start(self, service: str, platform: str, table: str) -> None:
        """Start a service and wait for its health."""
        state, config = self.folder / f"state-{platform}-{service}", self.folder / f"{service}.toml"
        state.mkdir(exist_ok=True)
        config.write_text(
            f'[platform]\nid = "{platform}"\nrouter = ["{self.local}"]\nstate_dir = "{state}"\n'
            f"health_interval_s = 0.5\n[{service}]\n{table}"
        )
        if service == "console":
            users = Users(state / "console-users.db")
            for user, role in USERS.items():
                users.add(user, role, PASSWORD)
            users.close()
        process = self.run(service, [sys.executable, "-m", f"sonarpost.services.{service}", "--config", str(config)])
        eventually(lambda: service in self.health or process.popen.poll() is not None, what=f"health of {service}")
        assert process.popen.poll() is None, process.log.read_text()[-3000:]

    def run(self, name: str, command: list[str]) -> Process:
        """Start a process."""
        container = ""
        if image := os.environ.get("SONARPOST_HOSTILE_CONTAINER"):
            container = f"sonarpost-{name}-{self.console_port}"
            limits = [f"--memory={MEMORY_BYTES}", f"--memory-swap={MEMORY_BYTES}", "--network=host"]
            paths = {"/usr", "/etc", REPOSITORY, self.folder, sys.base_prefix, Path(sys.prefix).resolve()}
            mounts = [f"-v={path}:{path}" for path in paths]
            names = ("PATH", "PYTHONPATH", "OPENBLAS_NUM_THREADS")
            settings = [f"-e={name}={os.environ[name]}" for name in names if name in os.environ]
            command = [
                "docker",
                "run",
                f"--name={container}",
                *limits,
                *mounts,
                *settings,
                f"-w={REPOSITORY}",
                image,
                *command,
            ]
        environment = {**os.environ, EXIT_WITH_PARENT: str(os.getpid()), "OMP_NUM_THREADS": "1"}
        log = self.folder / f"{name}.log"
        with log.open("ab") as output:
            popen = subprocess.Popen(
                command, cwd=REPOSITORY, stdin=subprocess.DEVNULL, stdout=output, stderr=output, env=environment
            )
        process = self.processes[name] = Process(name, popen, log, container)
        if container:
            inspect = ["docker", "inspect", "-f", "{{.State.Pid}}", container]

            def started() -> bool:
                process.pid = int(subprocess.run(inspect, capture_output=True, check=False).stdout.strip() or 0)
                return process.pid > 0 or popen.poll() is not None

            eventually(started, what=f"container {container}")
        return process

    def check(self) -> str:
        """Check that all services run within their memory; return their states and peaks."""
        found = []
        for name, process in self.processes.items():
            assert process.popen.poll() is None, f"{name} has ended:\n{process.log.read_text()[-3000:]}"
            process.measure()
            state = self.health[name].state if name in self.health else "runs"
            found.append(f"{name} {state} {process.peak_bytes / 2**20:.0f} MiB")
            assert process.peak_bytes < MEMORY_BYTES, found[-1]
        return ", ".join(found)

    def close(self) -> None:
        """Stop everything; check that each service ends after SIGTERM."""
        for sender in self._senders.values():
            sender.close()
        begin_s = time.monotonic()
        for process in self.processes.values():
            process.popen.terminate()
        codes = {name: process.popen.wait(WAIT_S) for name, process in self.processes.items()}
        print(f"ended {time.monotonic() - begin_s:.1f} s after SIGTERM: {codes}")
        for process in self.processes.values():
            if process.container:
                state = json.loads(subprocess.check_output(["docker", "inspect", process.container]))[0]["State"]
                print(process.name, "OOMKilled", state["OOMKilled"])
                subprocess.run(["docker", "rm", "-f", process.container], check=True, stdout=subprocess.DEVNULL)
                assert not state["OOMKilled"], process.name
        self._stack.close()
        assert set(codes.values()) == {0}, codes

    # Measured sources. Each returns the delay of every item in seconds; a missing one fails the test.

    def numbers(self, count: int) -> range:
        self._number += count
        return range(self._number - count, self._number)

    def images_of_vessel(self) -> list[float]:
        """Coded images of vessel-1, until they are decoded, stored and published."""
        parts = [coded_part(number) for number in self.numbers(8)]
        now_s = time.monotonic()
        self.sender(VESSEL).send(keys.shore_part(VESSEL), "c2", [wire.encode(part) for part in parts])
        return self.images.delays_s({part.i: now_s for part in parts})

    def requests_of_user(self) -> list[float]:
        """Requests of the user eva to the console."""
        cookie = self.log_in("eva")
        delays = []
        for path in ("/api/contacts", "/api/map", "/api/fleet", "/api/info", "/login") * 3:
            begin_s = time.monotonic()
            eventually(lambda path=path: self.get(path, cookie) == 200, what=f"reply to {path}")  # type: ignore[misc]
            delays.append(time.monotonic() - begin_s)
        return delays

    def queries_of_console(self) -> list[float]:
        """Queries of the certificate console-1, repeated if c2 refuses them as too many."""
        session, delays, errors = self.opened("console-1"), [], ["no reply"]
        for _ in range(5):
            begin_s = time.monotonic()

            def answered() -> bool:
                selector, last = f"{keys.shore_contact_all()}?limit=5", zenoh.ConsolidationMode.NONE
                replies = list(session.get(selector, consolidation=last, timeout=20.0))
                errors.extend(reply.err.payload.to_string() for reply in replies if reply.err is not None)
                return any(reply.ok is not None for reply in replies)

            eventually(answered, what=f"answer to a query after {errors[-3:]}")
            delays.append(time.monotonic() - begin_s)
        return delays

    def snippets_of_detector(self) -> list[float]:
        """Snippets for the compressor, until they are encoded."""
        names = [f"c{number}" for number in self.numbers(5)]
        now_s, pixels = time.monotonic(), np.random.default_rng(1).integers(0, 256, (80, 140), dtype=np.uint8)
        contacts = [Contact(contact_id=name, vehicle_id="uuv-1") for name in names]
        records = [wire.encode(Snippet(contact=one, pixels=Pixels.from_array(pixels))) for one in contacts]
        self.sender("uuv-1").send(keys.contact_detected("uuv-1"), "compressor", records)
        return self.logged("compressor", [f"contact_id={name} " for name in names], now_s)

    def recording_of_sonar(self) -> list[float]:
        """A recording in the folder of the detector, until it is processed."""
        [number] = self.numbers(1)
        path = self.folder / f"good-{number}.xtf"
        simulator = import_module("sonarpost.extensions.simulation.seabed.survey")
        write_xtf = import_module("sonarpost.extensions.simulation.seabed.xtf_writer").write_xtf
        write_xtf(simulator.simulate_survey(simulator.SurveySpec(seed=number + 1, pings=200, samples=512)).survey, path)
        begin_s = time.monotonic()
        path.rename(self.incoming / path.name)
        return self.logged("atd_stub", [f"File processed file={path.name} "], begin_s)

    def logged(self, service: str, words: Sequence[str], begin_s: float) -> list[float]:
        """Wait until a service has logged all words: the consumers of its records do not run."""
        log, delays = self.processes[service].log, []
        for one in words:
            eventually(lambda one=one: one in log.read_text(), what=one)  # type: ignore[misc]
            delays.append(time.monotonic() - begin_s)
        return delays

    # HTTP

    def log_in(self, user: str) -> str:
        """Return the cookie of a session."""
        body = json.dumps({"user": user, "password": PASSWORD}).encode()
        request = urllib.request.Request(f"{self.console_url}/api/login", body, {"Content-Type": "application/json"})
        cookie = ""

        def logged_in() -> bool:
            nonlocal cookie
            try:
                with urllib.request.urlopen(request, timeout=30) as reply:
                    cookie = reply.headers["Set-Cookie"].split(";")[0]
            except OSError:
                return False
            return True

        eventually(logged_in, what=f"log-in of {user}")
        return cookie

    def get(self, path: str, cookie: str = "", method: str = "GET", body: bytes | None = None) -> int:
        """Return the status of a request to the console; 0 without a reply."""
        return request(self.console_url + path, body, method, {"Cookie": cookie})


def request(url: str, body: bytes | None, method: str = "POST", headers: Mapping[str, str] | None = None) -> int:
    """Return the status of a request; 0 without a reply."""
    try:
        sent = urllib.request.Request(url, body, dict(headers or {}), method=method)
        with urllib.request.urlopen(sent, timeout=30) as reply:
            reply.read()
            return int(reply.status)
    except urllib.error.HTTPError as error:
        return error.code
    except (OSError, ValueError, HTTPException):
        return 0


@contextmanager
def running_site(folder: Path, world: World, decode_workers: int) -> Iterator[Site]:
    """A site with its services, while the memory of its processes is measured."""
    tls, local = f"tls/localhost:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    router = world.start("shore-1", world.shore_wanted(tls, local), zenoh_log=None)
    site = Site(folder, world, tls, local, decode_workers)
    stop, stack = threading.Event(), ExitStack()

    def measure() -> None:
        while not stop.wait(0.25):
            for process in list(site.processes.values()):
                process.measure()

    thread = threading.Thread(target=measure, daemon=True)
    thread.start()
    try:
        site.incoming.mkdir()
        # `c2_table` of an extension's attacks adds to `[c2]`.
        tables = [module.c2_table for module in modules("attacks") if hasattr(module, "c2_table")]
        added = "".join(stack.enter_context(table(site)) for table in tables)
        site.start(
            "c2",
            "shore-1",
            f'out_dir = "{folder / "out"}"\ndecode_workers = {decode_workers}\njson_mirror = true\n{added}',
        )
        site.start("console", "shore-1", f'role = "shore"\nport = {site.console_port}\n')
        site.start("compressor", "uuv-1", "")
        site.start(
            "atd_stub",
            "uuv-2",
            f'mode = "survey"\ninput_dir = "{site.incoming}"\npoll_s = 0.2\nsettle_s = 0.2\nmax_in_flight = 0\n',
        )
        yield site
        site.check()
    finally:
        stop.set()
        thread.join()
        stack.close()
        try:
            site.close()
        finally:
            router.stop()


@contextmanager
def threads(count: int, work: Callable[[int, threading.Event], Any]) -> Iterator[None]:
    """Run `work(number, stop)` in threads until the context ends."""
    stop = threading.Event()
    running = [threading.Thread(target=work, args=(number, stop), daemon=True) for number in range(count)]
    for thread in running:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in running:
            thread.join(1)  # a request that waits for its reply ends later
