"""Example programs as processes whose lines a test reads."""

import queue
import subprocess
import threading
from collections.abc import Callable

import pytest

from builders.common import WAIT_S


class LineProgram:
    """A running program and the lines that it prints."""

    def __init__(self, *command):
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.lines = queue.Queue()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.put(line.strip())

    def read(self, count):
        """Return the next lines."""
        return [self.lines.get(timeout=WAIT_S) for _ in range(count)]

    def wait(self, status=0):
        """Wait for the end of the program; return its standard error."""
        assert self.process.wait(timeout=WAIT_S) == status, self.process.stderr.read()
        return self.process.stderr.read()

    def stop(self):
        """End the program."""
        self.process.kill()
        self.process.wait()
        self._thread.join()
        for stream in (self.process.stdout, self.process.stderr):
            stream.close()


RunProgram = Callable[..., LineProgram]


@pytest.fixture
def run_program():
    """Starts programs; they are ended at the end of the test."""
    programs = []

    def start(*command):
        programs.append(LineProgram(*command))
        return programs[-1]

    yield start
    for program in programs:
        program.stop()
