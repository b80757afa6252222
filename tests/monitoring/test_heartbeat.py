"""Heartbeat file of a service, and the health check that reads it."""

import json
import os
import subprocess
import sys
import time

import pytest
from builders.common import eventually, running

from sonarpost.config import ServiceConfig
from sonarpost.messages import Health
from sonarpost.monitoring import healthcheck, heartbeat
from sonarpost.monitoring.healthcheck import check, health_problem
from sonarpost.monitoring.heartbeat import Heartbeat
from sonarpost.runtime.service import Service

NOW_S = 1000.0


def health(state="ok", detail="", inbox=0, handled=0):
    return Health(
        platform_id="vessel-1",
        service="relay",
        time_utc_s=0.0,
        started_utc_s=0.0,
        state=state,
        detail=detail,
        counters={"records_handled": handled},
        gauges={"inbox": inbox, "outbox": 0.0, "refused": 0.0},
    )


@pytest.fixture
def path(tmp_path):
    return tmp_path / "heartbeat.json"


@pytest.fixture
def heart(path, tmp_path):
    return Heartbeat({heartbeat.VARIABLE: str(path)}, tmp_path, 5.0)


def test_service_with_a_heartbeat_is_healthy(heart, path):
    assert heartbeat.VARIABLE == healthcheck.VARIABLE
    assert "has not started" in health_problem(path, NOW_S)
    heart.beat(health(), NOW_S)
    assert health_problem(path, NOW_S + 1) == ""
    assert check({"SONARPOST_HEARTBEAT": str(path)}, NOW_S + 1) == (0, "healthy")


@pytest.mark.parametrize("interval_s", [5.0, 60.0])
def test_old_heartbeat_means_a_hanging_process(path, tmp_path, interval_s):
    Heartbeat({heartbeat.VARIABLE: str(path)}, tmp_path, interval_s).beat(health(), NOW_S)
    age_s = 3 * interval_s
    assert health_problem(path, NOW_S + age_s) == ""
    assert health_problem(path, NOW_S + age_s + 0.1).startswith(f"hangs: last heartbeat {age_s:.0f} s ago")


@pytest.mark.parametrize("state", ["degraded", "stopping"])
def test_degraded_service_is_unhealthy_with_its_reason(heart, path, state):
    heart.beat(health(state, "records cannot be stored"), NOW_S)
    assert health_problem(path, NOW_S) == f"{state}: records cannot be stored"


def test_waiting_records_without_progress_are_a_stall(heart, path):
    heart.beat(health(inbox=3, handled=1), NOW_S)
    heart.beat(health(inbox=3, handled=1), NOW_S + 1800.0)
    assert health_problem(path, NOW_S + 1800.0) == ""
    heart.beat(health(inbox=4, handled=1), NOW_S + 1805.0)
    assert health_problem(path, NOW_S + 1805.0) == "stalled: 4 records wait and none was finished for 1805 s"
    heart.beat(health(inbox=4, handled=2), NOW_S + 1810.0)
    assert health_problem(path, NOW_S + 1810.0) == ""


def test_idle_service_is_not_stalled(heart, path):
    heart.beat(health(handled=1), NOW_S)
    heart.beat(health(handled=1), NOW_S + 9000.0)
    heart.beat(health(inbox=1, handled=1), NOW_S + 9005.0)
    assert health_problem(path, NOW_S + 9005.0) == ""


def test_stall_limit_is_configurable(heart, path):
    heart.beat(health(inbox=1), NOW_S)
    heart.beat(health(inbox=1), NOW_S + 10.0)
    environment = {"SONARPOST_HEARTBEAT": str(path), "SONARPOST_STALLED_AFTER_S": "9"}
    status, line = check(environment, NOW_S + 10.0)
    assert (status, line[:8]) == (1, "stalled:")
    assert check({**environment, "SONARPOST_STALLED_AFTER_S": "11"}, NOW_S + 10.0) == (0, "healthy")
    assert check({**environment, "SONARPOST_STALLED_AFTER_S": "soon"}, NOW_S)[1].endswith(
        "got 'soon', expected seconds"
    )


def test_full_disk_and_missing_folder_are_reported_before_a_record_fails(heart, path, tmp_path, monkeypatch):
    Heartbeat({heartbeat.VARIABLE: str(path)}, tmp_path / "gone", 5.0).beat(health(), NOW_S)
    assert health_problem(path, NOW_S) == f"{tmp_path / 'gone'}: No such file or directory"
    heart.beat(health(), NOW_S)
    monkeypatch.setattr(healthcheck, "MIN_FREE_BYTES", 1 << 62)
    assert "B free, expected at least" in health_problem(path, NOW_S)


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{}", b"\xff", b'{"beat_monotonic_s": "x"}', b'{"beat_monotonic_s": []}']
)
def test_error_names_an_invalid_heartbeat_file(path, content):
    path.write_bytes(content)
    assert str(path) in health_problem(path, NOW_S)
    assert "expected a heartbeat file" in health_problem(path, NOW_S)


def test_missing_variable_is_an_error():
    status, line = check({}, NOW_S)
    assert status == 1
    assert line.startswith("SONARPOST_HEARTBEAT is not set")


def test_unwritable_heartbeat_is_logged_once(tmp_path, caplog):
    heart = Heartbeat({heartbeat.VARIABLE: str(tmp_path / "no" / "heartbeat")}, tmp_path, 5.0)
    heart.beat(health(), NOW_S)
    heart.beat(health(), NOW_S + 5)
    assert [record.getMessage() for record in caplog.records] == ["Heartbeat not written"]


class Idle(Service[ServiceConfig]):
    """A service without records."""

    NAME = "relay"

    def handle(self, key, record, effects):
        raise AssertionError(key)


def test_command_reports_a_running_service_as_healthy(platform, path, monkeypatch):
    monkeypatch.setenv(heartbeat.VARIABLE, str(path))
    with running(Idle(platform("vessel-1"), ServiceConfig())) as service:
        eventually(path.exists, what="a heartbeat")
        done = subprocess.run(
            [sys.executable, "-m", "sonarpost.monitoring.healthcheck"],
            env={**os.environ, heartbeat.VARIABLE: str(path)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stdout) == (0, "healthy\n")
        service.set_degraded("the disk is full")
        eventually(
            lambda: health_problem(path, time.monotonic()) == "degraded: the disk is full", what="the degraded state"
        )
    assert json.loads(path.read_bytes())["state"] == "stopping"
