"""Service process: stops on a signal, reports errors in one line, ends with its parent."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from builders.common import REPOSITORY, eventually

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.messages import Health

TINY = """
import sys, threading
from collections.abc import Mapping
from sonarpost.messages import Decision, Record
from sonarpost.config import ServiceConfig
from sonarpost.runtime.process import main
from sonarpost.runtime.service import UnitOfWork, Service

class TinyConfig(ServiceConfig):
    hangs_on_stop: bool = False
    raises: bool = False

class Tiny(Service[TinyConfig]):
    '''Consumes decisions.'''
    NAME = "relay"

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return {"sonarpost/v1/vessel-1/contact/decision": Decision}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        effects.count("decisions")

    def on_start(self) -> None:
        if self.config.raises:
            self.start_thread(lambda: 1 // 0, "raises")

    def on_stop(self) -> None:
        if self.config.hangs_on_stop:
            threading.Event().wait()

sys.exit(main(Tiny, TinyConfig))
"""

Start = Callable[..., subprocess.Popen[str]]


def other_thread_of(process: subprocess.Popen[str]) -> int:
    """Return the identifier of a thread that is not the main thread."""
    return max(int(entry.name) for entry in Path(f"/proc/{process.pid}/task").iterdir())


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Starts the tiny service with the given configuration."""
    started: list[subprocess.Popen[str]] = []

    def start_one(configuration: str, **environment: str) -> subprocess.Popen[str]:
        path = tmp_path / "vessel.toml"
        path.write_text(configuration)
        process = subprocess.Popen(
            [sys.executable, "-c", TINY, "--config", str(path)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment},
        )
        started.append(process)
        return process

    yield start_one
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


def configuration(tmp_path: Path, router: str, own: str = "") -> str:
    return textwrap.dedent(f"""\
        [platform]
        id = "vessel-1"
        router = ["{router}"]
        state_dir = "{tmp_path / "state"}"
        health_interval_s = 0.1
        [relay]
        {own}
        """)


def read_until(process: subprocess.Popen[str], text: str) -> str:
    """Return the log up to the line with `text`."""
    assert process.stderr is not None
    lines = []
    for line in process.stderr:
        lines.append(line)
        if text in line:
            return "".join(lines)
    pytest.fail(f"ended without {text!r}:\n" + "".join(lines))


def end(process: subprocess.Popen[str], number: signal.Signals) -> tuple[int, float, str]:
    """Send a signal; return status, seconds until the end, and the rest of the log."""
    began = time.monotonic()
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    return process.returncode, time.monotonic() - began, err


def test_signal_that_another_thread_receives_stops_a_service(start: Start, tmp_path: Path, router: str) -> None:
    process = start(configuration(tmp_path, router))
    read_until(process, "Service started")
    time.sleep(0.3)  # the main thread waits
    os.kill(other_thread_of(process), signal.SIGTERM)
    assert process.wait(timeout=120) == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_stops_a_running_service_quickly(
    number: signal.Signals, start: Start, tmp_path: Path, router: str
) -> None:
    process = start(configuration(tmp_path, router))
    read_until(process, "Service started")
    status, seconds, log = end(process, number)
    assert status == 0
    assert seconds < 3
    assert f"Stopping signal={number.name}" in log
    assert log.rstrip().endswith("Service stopped")
    assert "Traceback" not in log


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_stops_a_service_that_waits_for_its_router(number: signal.Signals, start: Start, tmp_path: Path) -> None:
    process = start(configuration(tmp_path, "tcp/127.0.0.1:1"))
    read_until(process, "Zenoh router not reached")
    status, seconds, log = end(process, number)
    assert (status, "Traceback" in log) == (0, False)
    assert seconds < 3


def test_overridden_keys_are_logged_at_the_start(start: Start, tmp_path: Path, router: str) -> None:
    variables = {"SONARPOST_PLATFORM__HEALTH_INTERVAL_S": "9.0", "SONARPOST_PLATFORM__LOG_LEVEL": ""}
    process = start(configuration(tmp_path, router), **variables)
    read_until(process, "Configuration overridden by environment keys=platform.health_interval_s")
    end(process, signal.SIGTERM)


def test_a_service_notifies_systemd(start: Start, tmp_path: Path, router: str) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(str(tmp_path / "notify"))
        bound.settimeout(30)
        process = start(configuration(tmp_path, router), NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC="200000")
        assert bound.recv(4096).decode() == f"STATUS=waiting for the router {router}"
        assert bound.recv(4096) == b"READY=1\nSTATUS=started\nWATCHDOG_USEC=300000"
        assert {bound.recv(4096) for _ in range(5)} == {b"WATCHDOG=1\nSTATUS=ok"}
        process.send_signal(signal.SIGTERM)
        messages: list[bytes] = []
        while b"STOPPING=1\nSTATUS=stopping" not in messages:
            messages.append(bound.recv(4096))
    assert process.wait(timeout=120) == 0


def test_signal_stops_a_service_whose_consumer_does_not_reply(start: Start, tmp_path: Path, router: str) -> None:
    (tmp_path / "state").mkdir()
    store = Store(tmp_path / "state" / "relay.db")
    with store.transaction() as tx:
        for _ in range(20):
            tx.send("sonarpost/v1/shore/inbox/vessel-1", "c2", b"x" * 100_000, encoding="e")
    store.close()
    process = start(configuration(tmp_path, router))
    read_until(process, "Consumer not responding; records queued")
    status, seconds, log = end(process, signal.SIGTERM)
    assert (status, "Traceback" in log) == (0, False)
    assert seconds < 3
    store = Store(tmp_path / "state" / "relay.db")
    assert store.outbox_depth() == 20
    store.close()


def test_hanging_shutdown_is_ended(start: Start, tmp_path: Path, router: str) -> None:
    process = start(configuration(tmp_path, router, "hangs_on_stop = true"))
    read_until(process, "Service started")
    status, seconds, log = end(process, signal.SIGTERM)
    assert status == 3
    assert seconds < 5
    assert "Shutdown timed out" in log


def test_exception_in_a_thread_stops_the_service_with_its_traceback(start: Start, tmp_path: Path, router: str) -> None:
    process = start(configuration(tmp_path, router, "raises = true"))
    _, log = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "ZeroDivisionError" in log
    assert "Service stopped" in log


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[platform]\nid = 'vessel-1'\nrouters = []\n", "vessel.toml:3: platform.routers: got 'an unknown key'"),
        ("[relay]\n", "vessel.toml: platform.id: got 'nothing', expected a value"),
        ("[platform\n", "expected valid TOML"),
    ],
)
def test_invalid_configuration_is_status_2_and_one_line(start: Start, text: str, message: str) -> None:
    process = start(text)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert out == ""
    assert err.startswith("relay: ")
    assert message in err
    assert err.count("\n") == 1


def test_invalid_override_is_status_2_and_one_line(start: Start, tmp_path: Path, router: str) -> None:
    process = start(configuration(tmp_path, router), SONARPOST_RELAY__RAISES="often")
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert err == "relay: environment: SONARPOST_RELAY__RAISES: got 'often', expected a valid boolean\n"


def test_unreadable_store_is_status_2_and_one_line(start: Start, tmp_path: Path, router: str) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "relay.db").write_bytes(b"of another program" * 100)
    process = start(configuration(tmp_path, router))
    _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert err.count("\n") == 1
    assert "ERROR relay: Service cannot start" in err
    assert "cannot be opened as a sonarpost store" in err


def test_logs_are_json_if_configured(start: Start, tmp_path: Path, router: str) -> None:
    process = start(configuration(tmp_path, router), SONARPOST_PLATFORM__LOG_FORMAT="json")
    log = read_until(process, "Service started")
    assert all(
        re.match(r'\{"time": "20[^"]+Z", "level": "info", "service": "relay", ', line) for line in log.splitlines()
    )


def test_running_service_publishes_health_and_liveliness(
    start: Start, tmp_path: Path, router: str, client: zenoh.Session
) -> None:
    seen: list[Health] = []
    key = keys.health("vessel-1", "relay")
    client.declare_subscriber(key, lambda sample: seen.append(wire.decode(Health, sample.payload.to_bytes(), key)))
    process = start(configuration(tmp_path, router))

    def alive() -> bool:
        replies = client.liveliness().get(keys.alive("vessel-1", "relay"), timeout=2)
        return any(reply.ok is not None for reply in replies)

    eventually(lambda: len(seen) > 2 and seen[-1].state == "ok")
    assert alive()
    assert seen[-1].gauges.items() >= {"inbox": 0.0, "outbox": 0.0, "refused": 0.0}.items()
    assert seen[-1].gauges["disk_free_bytes"] > 0
    assert seen[-1].started_utc_s <= seen[0].time_utc_s < seen[-1].time_utc_s
    assert end(process, signal.SIGTERM)[0] == 0
    eventually(lambda: seen[-1].state == "stopping")
    eventually(lambda: not alive())


def test_help_names_the_service(start: Start) -> None:
    done = subprocess.run(
        [sys.executable, "-c", TINY, "--help"], capture_output=True, text=True, check=False, timeout=400
    )
    assert done.returncode == 0
    assert "usage: python -m sonarpost.services.relay" in done.stdout
    assert "Consumes decisions." in done.stdout


# End with the parent process

PARENT = """
import os, subprocess, sys
child = subprocess.Popen(sys.argv[1:], env={**os.environ, "SONARPOST_EXIT_WITH_PARENT": str(os.getpid())},
                         stdout=subprocess.DEVNULL)
print(child.pid, flush=True)
child.wait()
"""
on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="requires prctl of Linux")


def running(pid: int) -> bool:
    """Return whether a process runs; a zombie does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in "ZX"


@on_linux
def test_service_ends_when_its_parent_is_killed(tmp_path: Path, router: str) -> None:
    path = tmp_path / "vessel.toml"
    path.write_text(configuration(tmp_path, router))
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, sys.executable, "-c", TINY, "--config", str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    try:
        read_until(parent, "Service started")
        assert running(child)
    finally:
        parent.kill()
        # The child holds the other end of this pipe, which ends with both processes.
        _, log = parent.communicate(timeout=120)
    eventually(lambda: not running(child), 120, "the end of the service")
    assert "Stopping signal=SIGTERM" in log
    assert "Service stopped" in log


@on_linux
def test_service_without_its_parent_does_not_start(start: Start, tmp_path: Path, router: str) -> None:
    process = start(configuration(tmp_path, router), SONARPOST_EXIT_WITH_PARENT=str(os.getpid() + 1_000_000))
    _, log = process.communicate(timeout=120)
    assert process.returncode == 1
    assert log == ""


def test_service_outlives_its_parent_without_the_variable(tmp_path: Path, router: str) -> None:
    path = tmp_path / "vessel.toml"
    path.write_text(configuration(tmp_path, router))
    log_path = tmp_path / "log"
    script = PARENT.replace(', "SONARPOST_EXIT_WITH_PARENT": str(os.getpid())', "").replace("child.wait()", "")
    with log_path.open("w") as log:
        done = subprocess.run(
            [sys.executable, "-c", script, sys.executable, "-c", TINY, "--config", str(path)],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            check=True,
            timeout=400,
        )
    child = int(done.stdout)
    try:
        eventually(lambda: "Service started" in log_path.read_text())
    finally:
        os.kill(child, signal.SIGTERM)
    eventually(lambda: "Service stopped" in log_path.read_text())


# Embedded router


def router_process(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "sonarpost.bus.router", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_router_stops_on_a_signal(number: signal.Signals) -> None:
    process = router_process("--listen", "tcp/127.0.0.1:0")
    read_until(process, "Router started")
    status, seconds, _ = end(process, number)
    assert status == 0
    assert seconds < 3


def test_router_that_cannot_listen_is_status_2(router: str) -> None:
    process = router_process("--listen", router)
    _, log = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "Router cannot start" in log
    assert router in log
