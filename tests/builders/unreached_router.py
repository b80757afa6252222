"""Checks that a command prints why it does not reach its router."""

import subprocess
import sys

from builders.common import free_port


def check_unreached_router(arguments: str) -> None:
    """Run a command until it prints the reason."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [sys.executable, "-m", "sonarpost.cli.main", *arguments.split(), "--router", endpoint]
    lines = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        try:
            for line in process.stdout:
                lines.append(line)
                if f"no connection: {endpoint}: Connection refused" in line:
                    return
        finally:
            process.kill()
    raise AssertionError("".join(lines))
