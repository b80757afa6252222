"""`python -m research.relay_throughput` with few records."""

import json
import subprocess
import sys

import pytest
from builders.common import REPOSITORY

from research.relay_throughput import AREAS


def run(*options):
    command = [sys.executable, "-m", "research.relay_throughput", "--records", "40", *options]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    return result.returncode, [json.loads(line) for line in result.stdout.splitlines()], result.stderr


def test_every_round_and_the_medians_are_printed():
    status, lines, _ = run("--rounds", "2", "--peers", "")
    assert status == 0
    kinds = ("decision", "coded image")
    assert [(line["record"], line.get("round")) for line in lines] == [(k, n) for k in kinds for n in (1, 2, None)]
    for line in lines:
        assert min(line[f"{name}_per_s"] for name in ("sonarpost", "zenoh", "fsync")) > 0


def test_the_profile_finds_all_its_areas():
    status, [line], _ = run("--profile")
    assert status == 0
    assert line["cpu_us"].keys() == {*AREAS, "all"}
    assert min(line["cpu_us"].values()) > 0


@pytest.mark.parametrize("option", ["kafka", "nats,kafka"])
def test_an_unknown_peer_is_an_error(option):
    status, lines, error = run("--peers", option)
    assert (status, lines) == (2, [])
    assert "got kafka, expected some of nats, rabbitmq, redis" in error
