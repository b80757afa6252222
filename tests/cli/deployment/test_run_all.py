"""`sonarpost run all`: which processes it starts, restarts after a crash, errors of the configuration, Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from builders.common import eventually, free_port

from sonarpost.cli.deployment import run_all
from sonarpost.cli.deployment.run_all import Supervisor, router_module
from sonarpost.cli.main import main
from sonarpost.config import PlatformConfig
from sonarpost.errors import ConfigError


class RunAll:
    """A running `sonarpost run all` for one service, and its output."""

    def __init__(self, folder, endpoint):
        self.folder = folder
        self.config = folder / "vessel.toml"
        self.config.write_text(
            f'[platform]\nid = "vessel-1"\nrouter = ["{endpoint}"]\nstate_dir = "{folder}/state"\n[relay]\n'
        )
        self.process: subprocess.Popen[bytes] | None = None

    def start(self):
        command = [sys.executable, "-m", "sonarpost.cli.main", "run", "all", "--config", str(self.config)]
        environment = {**os.environ, "NOTIFY_SOCKET": "/nonexistent", "SONARPOST_HEARTBEAT": "/nonexistent/beat"}
        with (self.folder / "log").open("wb") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
        return self.process

    @property
    def log(self):
        return (self.folder / "log").read_text()

    def wait_for(self, text, count=1):
        eventually(lambda: self.log.count(text) >= count, 120, f"{text!r} in {self.folder}/log")

    def child(self, module):
        """Return the process identifier of a module."""
        assert self.process is not None
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        [found] = [int(pid) for pid in children if module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()]
        return found


Start = Callable[[str], RunAll]


@pytest.fixture
def bench(tmp_path):
    made: list[RunAll] = []

    def make(endpoint):
        made.append(RunAll(tmp_path, endpoint))
        return made[-1]

    yield make
    for each in made:
        if each.process is not None:
            each.process.kill()
            each.process.wait()


def test_a_killed_service_is_restarted_and_ctrl_c_stops_all(bench):
    run = bench(f"tcp/127.0.0.1:{free_port()}")
    process = run.start()
    run.wait_for("Service started")
    os.kill(run.child("services.relay"), signal.SIGKILL)
    run.wait_for("Service started", 2)
    assert "relay  | ended with status -9; restarting in 1 s" in run.log
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 0
    lines = run.log.splitlines()
    assert all(line.startswith(("relay  | ", "router | ")) for line in lines)
    assert lines[-1].endswith("Router stopped")
    assert "Traceback" not in run.log
    # Neither systemd's socket nor the heartbeat file belongs to several processes.
    assert "not notified" not in run.log
    assert "Heartbeat not written" not in run.log


def test_a_router_that_runs_already_is_used(bench, router):
    run = bench(router)
    process = run.start()
    run.wait_for("Service started")
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 0
    assert "Router" not in run.log
    assert run.log.startswith(f"router | not started: {router} has a router already, or is on another host\n")


def test_status_2_of_a_service_stops_all_with_status_2(bench):
    run = bench(f"tcp/127.0.0.1:{free_port()}")
    (run.folder / "state").mkdir()
    (run.folder / "state" / "relay.db").write_bytes(b"no database" * 1000)
    assert run.start().wait(90) == 2
    assert "ended with status 2: its configuration or its store is invalid; stopping all" in run.log
    assert run.log.count("Service cannot start") == 1
    assert run.log.rstrip().endswith("Router stopped")


def test_an_invalid_configuration_starts_nothing(bench, capsys):
    run = bench(f"tcp/127.0.0.1:{free_port()}")
    run.config.write_text(run.config.read_text() + "x = 1\n[op_modem]\naddress = 300\n")
    assert main(["run", "all", "--config", str(run.config)]) == 2
    captured = capsys.readouterr()
    assert [line.split(": got")[0] for line in captured.err.splitlines()] == [
        f"{run.config}:6: relay.x",
        f"{run.config}:7: op_modem.port",
        f"{run.config}:8: op_modem.address",
    ]
    assert captured.out == ""


def test_options_of_all_are_refused_for_one_service(capsys):
    assert main(["run", "relay", "--config", "x.toml", "--listen", "tcp/0.0.0.0:7448"]) == 2
    assert "got 'relay', expected the service all" in capsys.readouterr().err


# The router


def platform(*router, upstream=()):
    return PlatformConfig(id="vessel-1", router=router, upstream=upstream)


def test_the_router_listens_on_the_endpoints_of_this_host_and_connects_upstream():
    here = f"tcp/127.0.0.1:{free_port()}"
    assert router_module(platform(here, "tcp/192.0.2.1:7447"), None, []) == ["sonarpost.bus.router", "--listen", here]
    assert router_module(platform(here, upstream=("tcp/192.0.2.9:7448",)), None, ["tcp/0.0.0.0:7448"]) == [
        *("sonarpost.bus.router", "--listen", here, "tcp/0.0.0.0:7448"),
        *("--connect", "tcp/192.0.2.9:7448"),
    ]
    assert router_module(platform(here), Path("r.json5"), []) == ["sonarpost.bus.router", "--config", "r.json5"]
    assert router_module(platform(here), Path("r.json5"), ["tcp/0.0.0.0:7448"]) == [
        *("sonarpost.bus.router", "--config", "r.json5", "--listen", here, "tcp/0.0.0.0:7448")
    ]


def test_no_router_is_started_for_an_endpoint_of_another_host():
    assert router_module(platform("tcp/192.0.2.1:7447"), None, []) is None


def test_a_router_with_certificates_needs_a_file():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(ConfigError, match="--router-config FILE"):
        router_module(platform(endpoint, upstream=("tls/192.0.2.9:7448",)), None, [])


# Restarts


@pytest.fixture
def ending_module(tmp_path, monkeypatch):
    """Return a module that ends at once with status 1."""
    (tmp_path / "ends_at_once.py").write_text("import sys\nprint('begun')\nsys.exit(1)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "ends_at_once"


def test_the_wait_before_a_restart_doubles(ending_module, monkeypatch, capsys):
    monkeypatch.setattr(run_all, "FIRST_RESTART_S", 0.01)
    monkeypatch.setattr(run_all, "LAST_RESTART_S", 0.04)
    stop = threading.Event()
    supervisor = Supervisor(stop, width=4)
    waits: list[float] = []
    schedule = supervisor._schedule_restart

    def count_restart(name, status, now_s):
        schedule(name, status, now_s)
        waits.append(supervisor._restart_at_s[name] - now_s)
        if len(waits) == 4:
            stop.set()

    monkeypatch.setattr(supervisor, "_schedule_restart", count_restart)
    supervisor.start("ends", [ending_module])
    assert supervisor.supervise() == 0
    supervisor.stop()
    assert [round(wait_s, 3) for wait_s in waits] == [0.01, 0.02, 0.04, 0.04]
    assert "ends | begun" in capsys.readouterr().out


def test_a_process_that_was_stable_is_restarted_soon(ending_module, monkeypatch):
    supervisor = Supervisor(threading.Event(), width=4)
    supervisor.start("ends", [ending_module])
    supervisor.stop()
    started_s = supervisor._started_s["ends"]
    for _ in range(5):
        supervisor._schedule_restart("ends", 1, started_s + 1.0)
    assert supervisor._restart_at_s["ends"] == started_s + 1.0 + 16.0
    supervisor._schedule_restart("ends", 1, started_s + run_all.STABLE_S)
    assert supervisor._restart_at_s["ends"] == started_s + run_all.STABLE_S + run_all.FIRST_RESTART_S
