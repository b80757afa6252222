"""Service process: stops on a signal, reports errors in one line, ends with its parent."""

import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from builders.common import REPOSITORY, WAIT_S, eventually

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.messages import Health
from sonarpost.runtime.process import main
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

TINY = """
import sys, threading
from collections.abc import Mapping
from sonarpost.messages import Decision, Record
from sonarpost.config import ServiceConfig
from sonarpost.runtime.process import main
from sonarpost.runtime.service import UnitOfWork, Service

class TinyConfig(ServiceConfig):
    hangs_on_start: bool = False
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
        if self.config.hangs_on_start:
            print("start hangs", file=sys.stderr, flush=True)
            threading.Event().wait()
        if self.config.raises:
            self.start_thread(lambda: 1 // 0, "raises")

    def on_stop(self) -> None:
        if self.config.hangs_on_stop:
            threading.Event().wait()

sys.exit(main(Tiny, TinyConfig))
"""

Start = Callable[..., subprocess.Popen[str]]


def other_thread_of(process):
    """Return the identifier of a thread that is not the main thread."""
    return max(int(entry.name) for entry in Path(f"/proc/{process.pid}/task").iterdir())


@pytest.fixture
def start(tmp_path):
    """Starts the tiny service with the given configuration."""
    started: list[subprocess.Popen[str]] = []

    def start_one(configuration, **environment):
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


def configuration(tmp_path, router, own=""):
    return textwrap.dedent(f"""\
        [platform]
        id = "vessel-1"
        router = ["{router}"]
        state_dir = "{tmp_path / "state"}"
        health_interval_s = 0.1
        [relay]
        {own}
        """)


def read_until(process, text):
    """Return the log up to the line with `text`."""
    assert process.stderr is not None
    lines = []
    for line in process.stderr:
        lines.append(line)
        if text in line:
            return "".join(lines)
    pytest.fail(f"ended without {text!r}:\n" + "".join(lines))


def end(process, number=signal.SIGTERM):
    """Send a signal; return the exit status, and the rest of the log. A stop that takes 2.5 s has another status."""
    process.send_signal(number)
    _, err = process.communicate(timeout=WAIT_S)
    return process.returncode, err


def test_signal_that_another_thread_receives_stops_a_service(start, tmp_path, router):
    process = start(configuration(tmp_path, router))
    read_until(process, "Service started")
    # The main thread waits.
    eventually(lambda: Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "S")
    os.kill(other_thread_of(process), signal.SIGTERM)
    assert process.wait(timeout=WAIT_S) == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_stops_a_running_service_and_logs_are_json_if_configured(number, start, tmp_path, router):
    as_json = number == signal.SIGINT
    process = start(configuration(tmp_path, router), SONARPOST_PLATFORM__LOG_FORMAT="json" if as_json else "")
    log = read_until(process, "Service started")
    status, rest = end(process, number)
    assert status == 0
    assert "Traceback" not in rest
    last_lines = "\n".join(rest.splitlines()[-3:])
    assert number.name in last_lines
    assert "Service stopped" in last_lines
    pattern = r'\{"time": "20[^"]+Z", "level": "info", "service": "relay", '
    assert all(bool(re.match(pattern, line)) == as_json for line in (log + rest).splitlines())
    if not as_json:
        assert f"Stopping signal={number.name}" in rest
        assert rest.rstrip().endswith("Service stopped")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_stops_a_service_that_waits_for_its_router(number, start, tmp_path):
    process = start(configuration(tmp_path, "tcp/127.0.0.1:1"))
    read_until(process, "Zenoh router not reached")
    status, log = end(process, number)
    assert (status, "Traceback" in log) == (0, False)


def test_running_service_notifies_systemd_and_publishes_health_and_liveliness(start, tmp_path, router, client):
    seen: list[Health] = []
    key = keys.health("vessel-1", "relay")
    client.declare_subscriber(key, lambda sample: seen.append(wire.decode(Health, sample.payload.to_bytes(), key)))

    def alive():
        replies = client.liveliness().get(keys.alive("vessel-1", "relay"), timeout=WAIT_S)
        return any(reply.ok is not None for reply in replies)

    environment = {
        "NOTIFY_SOCKET": str(tmp_path / "notify"),
        "WATCHDOG_USEC": "200000",
        "SONARPOST_PLATFORM__HEALTH_INTERVAL_S": "0.1",
        "SONARPOST_PLATFORM__LOG_LEVEL": "",
    }
    stopping, received = b"STOPPING=1\nSTATUS=stopping", []

    def collect():
        while stopping not in received:
            received.append(bound.recv(4096))

    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound, ThreadPoolExecutor() as pool:
        bound.bind(str(tmp_path / "notify"))
        bound.settimeout(WAIT_S)
        collected = pool.submit(collect)
        process = start(configuration(tmp_path, router), **environment)
        read_until(process, "Configuration overridden by environment keys=platform.health_interval_s")
        eventually(lambda: len(received) >= 7)
        assert received[0].decode() == f"WATCHDOG=1\nSTATUS=waiting for the router {router}"
        assert received[1] == b"READY=1\nSTATUS=started\nWATCHDOG_USEC=300000"
        assert set(received[2:7]) == {b"WATCHDOG=1\nSTATUS=ok"}
        eventually(lambda: len(seen) > 2 and seen[-1].state == "ok")
        assert alive()
        assert seen[-1].gauges.items() >= {"inbox": 0.0, "outbox": 0.0, "refused": 0.0}.items()
        assert seen[-1].gauges["disk_free_bytes"] > 0
        assert seen[-1].started_utc_s <= seen[0].time_utc_s < seen[-1].time_utc_s
        process.send_signal(signal.SIGTERM)
        collected.result()
    assert process.wait(timeout=WAIT_S) == 0
    eventually(lambda: seen[-1].state == "stopping")
    eventually(lambda: not alive())


def test_signal_stops_a_service_whose_consumer_does_not_reply(start, tmp_path, router):
    (tmp_path / "state").mkdir()
    store = Store(tmp_path / "state" / "relay.db")
    with store.transaction() as tx:
        for _ in range(20):
            tx.send("sonarpost/v1/shore/inbox/vessel-1", "c2", b"x" * 100_000, encoding="e")
    store.close()
    process = start(configuration(tmp_path, router))
    read_until(process, "Consumer not responding; records queued")
    status, log = end(process)
    assert (status, "Traceback" in log) == (0, False)
    store = Store(tmp_path / "state" / "relay.db")
    assert store.outbox_depth() == 20
    store.close()


def test_hanging_shutdown_is_ended(start, tmp_path, router):
    process = start(configuration(tmp_path, router, "hangs_on_stop = true"))
    read_until(process, "Service started")
    status, log = end(process)
    assert (status, "Shutdown timed out" in log) == (3, True)


def test_start_that_hangs_is_ended(start, tmp_path, router):
    process = start(configuration(tmp_path, router, "hangs_on_start = true"))
    read_until(process, "start hangs")
    status, log = end(process)
    assert (status, "Stopping signal=SIGTERM" in log, "Shutdown timed out" in log) == (3, True, True)


def test_service_whose_log_is_not_read_is_ended(start, tmp_path, router):
    """A write to a full pipe blocks, and holds the lock of the log."""
    process = start(configuration(tmp_path, router))
    read_until(process, "Service started")
    with open(f"/proc/{process.pid}/fd/2", "wb", buffering=0, opener=nonblocking) as pipe:
        while pipe.write(bytes(4096)):
            pass
        process.send_signal(signal.SIGTERM)
        assert process.wait(WAIT_S) == -signal.SIGALRM


def nonblocking(path, flags):
    return os.open(path, flags | os.O_NONBLOCK)


COMMAND = """
import sys, threading
from sonarpost.stop_signals import stop_on_signals
with stop_on_signals() as stop:
    print("started", file=sys.stderr, flush=True)
    (stop if sys.argv[1] == "waits" else threading.Event()).wait()
print("ended", file=sys.stderr)
"""


@pytest.mark.parametrize(("waits_for", "expected"), [("waits", 0), ("hangs", -signal.SIGALRM)])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_a_command_that_hangs(waits_for, expected, number):
    with subprocess.Popen([sys.executable, "-c", COMMAND, waits_for], stderr=subprocess.PIPE, text=True) as process:
        read_until(process, "started")
        status, log = end(process, number)
    assert (status, "ended" in log) == (expected, expected == 0)


def test_exception_in_a_thread_stops_the_service_with_its_traceback(start, tmp_path, router):
    process = start(configuration(tmp_path, router, "raises = true"))
    _, log = process.communicate(timeout=WAIT_S)
    assert process.returncode == 1
    assert "ZeroDivisionError" in log
    assert "Service stopped" in log


# Errors at the start, in this process


@pytest.fixture
def start_here(tmp_path, capfd):
    """Run the main function of the relay with a configuration; return exit status and what it writes."""
    umask = os.umask(0o022)

    def run(text):
        (tmp_path / "vessel.toml").write_text(text)
        status = main(RelayService, RelayConfig, ["--config", str(tmp_path / "vessel.toml")])
        out, err = capfd.readouterr()
        assert out == ""
        return status, err

    yield run
    os.umask(umask)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[platform]\nid = 'vessel-1'\nrouters = []\n", "vessel.toml:3: platform.routers: got 'an unknown key'"),
        ("[relay]\n", "vessel.toml: platform.id: got 'nothing', expected a value"),
        ("[platform\n", "expected valid TOML"),
    ],
)
def test_invalid_configuration_is_status_2_and_one_line(start_here, text, message):
    status, err = start_here(text)
    assert status == 2
    assert err.startswith("relay: ")
    assert message in err
    assert err.count("\n") == 1


def test_invalid_override_is_status_2_and_one_line(start_here, tmp_path, router, monkeypatch):
    monkeypatch.setenv("SONARPOST_RELAY__SUPERSEDE", "often")
    expected = "relay: environment: SONARPOST_RELAY__SUPERSEDE: got 'often', expected a valid boolean\n"
    assert start_here(configuration(tmp_path, router)) == (2, expected)


def test_unreadable_store_is_status_2_and_one_line(start_here, tmp_path, router):
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "relay.db").write_bytes(b"of another program" * 100)
    status, err = start_here(configuration(tmp_path, router))
    assert (status, err.count("\n")) == (2, 1)
    assert "ERROR relay: Service cannot start" in err
    assert "cannot be opened as a sonarpost store" in err


def test_damaged_store_is_refused_with_the_command_that_recovers_it(start_here, tmp_path, router):
    store = Store(tmp_path / "state" / "relay.db")
    with store.transaction() as tx:
        for number in range(100):
            tx.send("k", "c2", b"%d" % number * 500, encoding="e")
    store.close()
    with store.path.open("r+b") as file:
        file.seek((store.path.stat().st_size // 4096 - 5) * 4096)
        file.write(b"\xa5" * 4096)
    status, err = start_here(configuration(tmp_path, router))
    assert (status, err.count("Service cannot start")) == (2, 1)
    assert f"sonarpost store salvage {store.path} --out NEW" in err


def test_objects_of_the_start_are_not_searched_for_garbage_and_later_cycles_are_freed():
    program = """if True:
        import gc, weakref
        from sonarpost.runtime.process import GARBAGE_THRESHOLD, tune_interpreter
        class Cycle:
            pass
        tune_interpreter()
        assert gc.get_freeze_count() > 10_000
        one = Cycle()
        one.itself, gone = one, weakref.ref(one)
        del one
        kept = [[] for _ in range(GARBAGE_THRESHOLD + 1)]
        assert gone() is None
    """
    subprocess.run([sys.executable, "-c", program], check=True)


def test_help_names_the_service(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(RelayService, RelayConfig, ["--help"])
    out = capsys.readouterr().out
    assert "usage: sonarpost run relay" in out
    assert RelayService.__doc__.split(".")[0] in " ".join(out.split())


# End with the parent process

PARENT = """
import os, subprocess, sys
child = subprocess.Popen(sys.argv[1:], env={**os.environ, "SONARPOST_EXIT_WITH_PARENT": str(os.getpid())},
                         stdout=subprocess.DEVNULL)
print(child.pid, flush=True)
child.wait()
"""
on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="requires prctl of Linux")


def running(pid):
    """Return whether a process runs; a zombie does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in "ZX"


@on_linux
def test_service_ends_when_its_parent_is_killed(tmp_path, router):
    path = tmp_path / "vessel.toml"
    path.write_text(configuration(tmp_path, router))
    command = [sys.executable, "-c", PARENT, sys.executable, "-c", TINY, "--config", str(path)]
    parent = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    try:
        read_until(parent, "Service started")
        assert running(child)
    finally:
        parent.kill()
        # The child holds the other end of this pipe, which ends with both processes.
        _, log = parent.communicate(timeout=WAIT_S)
    eventually(lambda: not running(child), what="the end of the service")
    assert "Stopping signal=SIGTERM" in log
    assert "Service stopped" in log


@on_linux
def test_service_without_its_parent_does_not_start(start, tmp_path, router):
    process = start(configuration(tmp_path, router), SONARPOST_EXIT_WITH_PARENT=str(os.getpid() + 1_000_000))
    _, log = process.communicate(timeout=WAIT_S)
    assert process.returncode == 1
    assert log == ""


def test_service_outlives_its_parent_without_the_variable(tmp_path, router):
    path, log_path = tmp_path / "vessel.toml", tmp_path / "log"
    path.write_text(configuration(tmp_path, router))
    script = PARENT.replace(', "SONARPOST_EXIT_WITH_PARENT": str(os.getpid())', "").replace("child.wait()", "")
    command = [sys.executable, "-c", script, sys.executable, "-c", TINY, "--config", str(path)]
    with log_path.open("w") as log:
        child = int(subprocess.run(command, stdout=subprocess.PIPE, stderr=log, check=True, timeout=WAIT_S).stdout)
    try:
        eventually(lambda: "Service started" in log_path.read_text())
    finally:
        os.kill(child, signal.SIGTERM)
    eventually(lambda: "Service stopped" in log_path.read_text())


# Embedded router


def router_process(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "sonarpost.bus.router", *arguments], stderr=subprocess.PIPE, text=True, cwd=REPOSITORY
    )


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_router_stops_on_a_signal(number):
    process = router_process("--listen", "tcp/127.0.0.1:0")
    read_until(process, "Router started")
    assert end(process, number)[0] == 0


def test_router_that_cannot_listen_is_status_2(router):
    process = router_process("--listen", router)
    _, log = process.communicate(timeout=WAIT_S)
    assert process.returncode == 2
    assert "Router cannot start" in log
    assert router in log
