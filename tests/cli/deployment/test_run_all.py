"""`sonarpost run all`: which processes it starts, restarts after a crash, errors of the configuration, Ctrl-C."""

import io
import os
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from builders.common import eventually, free_port

from sonarpost.cli import run as run_command
from sonarpost.cli.main import main
from sonarpost.cli.run import Supervisor, router_module
from sonarpost.config import PlatformConfig
from sonarpost.errors import ConfigError


class RunAll:
    """A running `sonarpost run all` for one service, and its output."""

    def __init__(self, folder, endpoint):
        self.folder, self.config, self.process = folder, folder / "vessel.toml", None
        self.config.write_text(
            f'[platform]\nid = "vessel-1"\nrouter = ["{endpoint}"]\nstate_dir = "{folder}/state"\n[relay]\n'
        )

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
        eventually(lambda: self.log.count(text) >= count, what=f"{text!r} in {self.folder}/log")

    def child(self, module):
        """Return the process identifier of a module."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        [found] = [int(pid) for pid in children if module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()]
        return found


@pytest.fixture
def bench(tmp_path):
    made = []
    yield lambda endpoint: made.append(RunAll(tmp_path, endpoint)) or made[-1]
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
    assert process.wait() == 0
    lines = run.log.splitlines()
    assert all(line.startswith(("relay  | ", "router | ")) for line in lines)
    assert lines[-1].endswith("Router stopped")
    assert "Traceback" not in run.log
    # Neither systemd's socket nor the heartbeat file belongs to several processes.
    assert "not notified" not in run.log
    assert "Heartbeat not written" not in run.log


@pytest.mark.system
def test_a_router_that_runs_already_is_used(bench, router):
    run = bench(router)
    process = run.start()
    run.wait_for("Service started")
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 0
    assert "Router" not in run.log
    assert run.log.startswith(f"router | not started: {router} has a router already, or is on another host\n")


@pytest.mark.system
def test_status_2_of_a_service_stops_all_with_status_2(bench):
    run = bench(f"tcp/127.0.0.1:{free_port()}")
    (run.folder / "state").mkdir()
    (run.folder / "state" / "relay.db").write_bytes(b"no database" * 1000)
    assert run.start().wait() == 2
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


class Bench:
    """Processes that live as long as it is told, their clock, and the event that ends their supervision."""

    names = ("ends",)

    def __init__(self, monkeypatch, *lives_s, ended_with=1):
        self.now_s, self.lives_s, self.started_s, self.ended_with = 0.0, lives_s, [], ended_with
        monkeypatch.setattr(run_command, "Processes", lambda: self)
        monkeypatch.setattr(run_command, "time", self)

    def spawn(self, *_):
        self.started_s.append(self.now_s)
        return SimpleNamespace(stdout=io.BytesIO(b"begun\n"))

    def status(self, _name):
        is_over = self.now_s - self.started_s[-1] >= self.lives_s[len(self.started_s) - 1]
        return self.ended_with if is_over else None

    def wait(self, duration_s):
        self.now_s += duration_s
        return len(self.started_s) == len(self.lives_s) > 1

    def monotonic(self):
        return self.now_s


def test_the_wait_before_a_restart_doubles_until_a_process_was_stable(monkeypatch, capsys):
    lives_s = (0.0,) * 7 + (run_command.STABLE_S, 0.0, 0.0)
    bench = Bench(monkeypatch, *lives_s)
    supervisor = Supervisor(bench, width=4)
    supervisor.start("ends", ["module"])
    assert supervisor.supervise() == 0
    waits_s = [1, 2, 4, 8, 16, 32, 60, 1, 2]
    lines = [line for line in capsys.readouterr().out.splitlines() if "begun" not in line]
    assert lines == [f"ends | ended with status 1; restarting in {wait_s} s" for wait_s in waits_s]
    pauses_s = [later - earlier for earlier, later in pairwise(bench.started_s)]
    expected = [life_s + wait_s for life_s, wait_s in zip(lives_s, waits_s, strict=False)]
    assert pauses_s == pytest.approx(expected, abs=0.31)


def test_status_2_ends_the_supervision_with_status_2(monkeypatch, capsys):
    supervisor = Supervisor(Bench(monkeypatch, 0.0, ended_with=2), width=4)
    supervisor.start("ends", ["module"])
    assert supervisor.supervise() == 2
    text = "ends | ended with status 2: its configuration or its store is invalid; stopping all\n"
    assert text in capsys.readouterr().out
