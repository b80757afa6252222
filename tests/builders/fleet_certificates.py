"""A fleet with certificates, and router processes whose logs tests read."""

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh

from builders.common import eventually, free_port
from sonarpost.bus.session import client_config
from sonarpost.config import TlsConfig
from sonarpost.security.fleet import Fleet
from sonarpost.security.router_config import RouterOptions, router_json5

DAY_S = 86400.0
TRACED = "warn,zenoh::net::routing::interceptor=trace"
"""Filter of Zenoh's log that shows every decision of access control."""
_DECISION = re.compile(
    r".*ThreadId\((?P<thread>\d+)\).*: (?:Using cached result: )?(?P<zid>[0-9a-f]+) .*is (?P<no>un)?authorized to "
    r"(?P<message>.+?) \((?P<flow>ingress|egress)\) on (?P<key>.*)"
)
_INTERCEPTED = re.compile(r".*ThreadId\((?P<thread>\d+)\).*: Msg intercepted!")


def tls_of(folder: Path) -> TlsConfig:
    return TlsConfig(ca=folder / "ca.pem", certificate=folder / "certificate.pem", key=folder / "key.pem")


class Router:
    """A router process and its log lines."""

    def __init__(self, config: Path, zenoh_log: str | None = TRACED) -> None:
        environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sonarpost.bus.router", "--config", str(config)],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            env=environment if zenoh_log is None else {**environment, "RUST_LOG": zenoh_log},
        )
        self.lines: list[str] = []
        self.first_line = 0
        """First line of the present test."""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.lines.append(line)

    def logged(self, *words: str) -> bool:
        """Return whether a line since the begin of the present test has these words."""
        return any(all(word in line for word in words) for line in self.lines[self.first_line :])

    def wait_for(self, *words: str) -> None:
        def logged_or_over() -> bool:
            return self.logged(*words) or (self.process.poll() is not None and not self._thread.is_alive())

        eventually(logged_or_over, what=f"{words} in the log of the router")
        assert self.logged(*words), f"the router did not log {words}:\n{''.join(self.lines)}"

    def denied(self) -> list[tuple[str, str, str]]:
        """Return (peer, message, key) of every incoming message denied in this test; all empty for an oversized one.

        Zenoh logs a decision for each message, some ahead of time, and then that a message was intercepted.
        """
        names: dict[str, str] = {}
        last: dict[str, tuple[str, str, str]] = {}
        found = []
        for number, line in enumerate(list(self.lines)):
            if match := _DECISION.match(line):
                if name := re.search(r"CertCommonName\(([^()]*)\)", line):
                    names[match["zid"]] = name[1]
                outgoing = match["no"] and match["flow"] == "egress"
                denial = (names.get(match["zid"], ""), match["message"], match["key"]) if match["no"] else ("", "", "")
                last[match["thread"]] = ("", "outgoing", "") if outgoing else denial
            elif match := _INTERCEPTED.match(line):
                denial = last.pop(match["thread"], ("", "", ""))
                found += [denial] if number >= self.first_line else []
        return [denial for denial in found if denial[1] != "outgoing"]

    def wait_for_denial(self, peer: str, message: str, key: str) -> None:
        def denied() -> bool:
            return any(p == peer and message in m and key in k for p, m, k in self.denied())

        eventually(denied, what=f"denial of {message} {key} from {peer}")

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait()
        self._thread.join()
        assert self.process.stderr is not None
        self.process.stderr.close()


@dataclass
class World:
    """Routers of a shore and a vessel, linked by TLS, and certificates of all kinds."""

    folder: Path
    fleet: Fleet
    shore_tls: str
    shore_local: str
    vessel_local: str
    vessel_tls: str
    folders: dict[str, Path]
    routers: dict[str, Router] = field(default_factory=dict)

    def start(self, platform: str, wanted: RouterOptions, zenoh_log: str | None = TRACED) -> Router:
        path = self.folder / f"{platform}-{len(self.routers)}.json5"
        path.write_text(router_json5(self.fleet.index(), wanted, time.time()), encoding="utf-8")
        router = Router(path, zenoh_log)
        self.routers[path.stem] = router
        router.wait_for("Router started")
        return router

    def shore_wanted(self, shore_tls: str, shore_local: str) -> RouterOptions:
        return RouterOptions("shore-1", listen=[shore_tls], local=[shore_local], files=self.folders["shore-1"])

    @property
    def shore(self) -> Router:
        return self.routers["shore-1-0"]

    @property
    def vessel(self) -> Router:
        return self.routers["vessel-1-1"]

    def tls(self, name: str) -> TlsConfig:
        return tls_of(self.folders[name])

    def open(self, name: str, mode: str = "client", endpoint: str = "") -> zenoh.Session:
        """Open a session at the shore's TLS endpoint with the certificate of `name`."""
        config = client_config([endpoint or self.shore_tls], self.tls(name))
        config.insert_json5("mode", json.dumps(mode))
        return zenoh.open(config)


def shifted(now_days: float) -> Callable[[], float]:
    return lambda: time.time() + now_days * DAY_S


@contextmanager
def _new_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    folder = tmp_path_factory.mktemp("fleet")
    fleet = Fleet.init(folder / "pki", "test")
    folders = {
        "shore-1": fleet.issue("shore-1", "shore", ["localhost", "127.0.0.1"]).folder,
        "vessel-1": fleet.issue("vessel-1", "vessel", ["localhost"]).folder,
        "vessel-2": fleet.issue("vessel-2", "vessel").folder,
        "vessel-3": fleet.issue("vessel-3", "vessel").folder,
        "uuv-1": fleet.issue("uuv-1", "uuv").folder,
        "console-1": fleet.issue("console-1", "console").folder,
        "observer-1": fleet.issue("observer-1", "observer").folder,
        # Issued 40 days ago for 10 days by the same authority.
        "expired": Fleet(fleet.folder, lambda: b"", shifted(-40)).issue("vessel-4", "vessel", days=10).folder,
        "nameless": fleet.issue("shore-2", "shore", ["elsewhere.example"]).folder,
    }
    fleet.revoke("vessel-3", "lost at sea")
    folders["vessel-3.g2"] = fleet.issue("vessel-3", "vessel").folder
    other = Fleet.init(folder / "other", "another fleet")
    folders["stranger"] = other.issue("vessel-1", "vessel").folder
    port = [free_port() for _ in range(4)]
    made = World(
        folder,
        fleet,
        f"tls/localhost:{port[0]}",
        f"tcp/127.0.0.1:{port[1]}",
        f"tcp/127.0.0.1:{port[2]}",
        f"tls/localhost:{port[3]}",
        folders,
    )
    try:
        made.start("shore-1", made.shore_wanted(made.shore_tls, made.shore_local))
        made.start(
            "vessel-1",
            RouterOptions(
                "vessel-1",
                listen=[made.vessel_tls],
                local=[made.vessel_local],
                connect=[made.shore_tls],
                files=folders["vessel-1"],
            ),
        )
        yield made
    finally:
        for router in made.routers.values():
            router.stop()


@pytest.fixture(scope="session")
def shared_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with _new_world(tmp_path_factory) as made:
        made.shore.wait_for("Peer connected", "peer=vessel-1")
        yield made


@pytest.fixture
def world(shared_world: World) -> World:
    """The world of all tests; what its routers log is that of this test."""
    for router in shared_world.routers.values():
        router.first_line = len(router.lines)
    return shared_world


@pytest.fixture
def own_world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """A world whose routers and certificates a test changes."""
    with _new_world(tmp_path_factory) as made:
        yield made


@pytest.fixture
def shore_session(world: World) -> Iterator[zenoh.Session]:
    """Session of a service at the shore's router."""
    session = zenoh.open(client_config([world.shore_local]))
    yield session
    session.close()


@pytest.fixture
def vessel_session(world: World) -> Iterator[zenoh.Session]:
    """Session of a service at the vessel's router, which is linked to the shore's."""
    session = zenoh.open(client_config([world.vessel_local]))
    yield session
    session.close()


def matching(session: zenoh.Session, key: str) -> zenoh.Publisher:
    """Declare a publisher and wait for a subscriber."""
    publisher = session.declare_publisher(key)
    eventually(lambda: bool(publisher.matching_status.matching), what=f"a subscriber of {key}")
    return publisher
