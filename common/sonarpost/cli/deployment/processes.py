"""Child processes of a command, by name: started, stopped in order, and ended with their parent."""

import os
import subprocess
import time
from collections.abc import Collection, Mapping, Sequence
from typing import IO

from sonarpost.stop_signals import EXIT_WITH_PARENT

STOP_S = 5.0


class Processes:
    """Processes by name."""

    def __init__(self) -> None:
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all processes that were started."""
        return tuple(self._processes)

    def spawn(
        self, name: str, command: Sequence[str], output: IO[bytes] | int, environment: Mapping[str, str] = os.environ
    ) -> subprocess.Popen[bytes]:
        """Start a process.

        Args:
            name: Name of the process; an ended process of this name is replaced.
            command: The program and its arguments.
            output: File of standard output and standard error, or `subprocess.PIPE`.
            environment: Environment variables.
        """
        self._processes[name] = process = subprocess.Popen(  # noqa: S603 our own commands
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            # If this process is killed, the child processes end too.
            env={**environment, EXIT_WITH_PARENT: str(os.getpid())},
            # Ctrl-C reaches this process only, which stops the others in order.
            process_group=0,
        )
        return process

    def pid(self, name: str) -> int:
        """Process identifier of a process."""
        return self._processes[name].pid

    def status(self, name: str) -> int | None:
        """Return the exit status of a process, None while it runs."""
        return self._processes[name].poll()

    def stop_in_order(self, last: Collection[str]) -> None:
        """Stop all processes, those in `last` after the others; one that does not stop within 5 s is killed."""
        for group in ([name for name in self._processes if name not in last], last):
            running = [self._processes[name] for name in group if name in self._processes and self.status(name) is None]
            for process in running:
                process.terminate()
            deadline = time.monotonic() + STOP_S
            for process in running:
                try:
                    process.wait(timeout=max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
