"""Every command that waits for a router prints why it is not reached."""

from __future__ import annotations

import subprocess
import sys

import pytest
from builders.common import free_port


@pytest.mark.parametrize(
    "arguments",
    [
        "c2 watch",
        "c2 cot udp://127.0.0.1:9",
        "c2 alert --webhook http://127.0.0.1:9 --state {folder}/alerts.db",
        "c2 comment uuv-1/AAAA --vessel vessel-1 --timeout 0.1",
        "record {folder}/new.mcap",
        "replay {folder}/records.mcap",
        "replay {folder}/records.mcap --to-c2",
        "status --interval 0.1",
        "status --interval 0.1 --json",
        "metrics --port 0",
    ],
)
def test_reason_is_printed_without_verbosity(arguments, tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    words = [*arguments.format(folder=tmp_path).split(), "--router", endpoint]
    command = [sys.executable, "-m", "sonarpost.cli.main", *words]
    lines = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            for line in process.stdout:
                lines.append(line)
                if f"no connection: {endpoint}: Connection refused" in line:
                    return
        finally:
            process.kill()
    pytest.fail("".join(lines))
