"""The examples that catch up and then subscribe, as separate processes with a c2.

Rust is tested where the program has been built: in `examples/rust/target`, or in the folder that
`SONARPOST_EXAMPLES_TARGET` names. JavaScript is tested where Node is installed.
"""

from __future__ import annotations

import os
import queue
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from builders.common import REPOSITORY, eventually
from builders.exports import decision, image
from builders.rest_interface import rest_interface

from sonarpost import keys, wire
from sonarpost.config import PlatformConfig
from sonarpost.messages import Decision, ReconstructedImage, Relayed
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

EXAMPLES = REPOSITORY / "examples"
PYTHON = EXAMPLES / "catch_up.py"
JAVASCRIPT = EXAMPLES / "javascript" / "catch_up.mjs"


class Program:
    """A running example and its lines."""

    def __init__(self, *command: str) -> None:
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        self.lines: queue.Queue[str] = queue.Queue()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.put(line.strip())

    def read(self, count: int) -> list[str]:
        return [self.lines.get(timeout=120) for _ in range(count)]

    def stop(self) -> None:
        """End the program."""
        self.process.kill()
        self.process.wait()
        self._thread.join()
        for stream in (self.process.stdout, self.process.stderr):
            assert stream is not None
            stream.close()


Run = Callable[..., Program]


@pytest.fixture
def run() -> Iterator[Run]:
    programs: list[Program] = []

    def start(*command: str) -> Program:
        programs.append(Program(*command))
        return programs[-1]

    yield start
    for program in programs:
        program.stop()


@pytest.fixture
def c2(platform: Callable[[str], PlatformConfig], tmp_path: Path) -> Iterator[C2Service]:
    service = C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out", json_mirror=True))
    assert service.start()
    yield service
    service.stop()


@pytest.fixture
def pair(
    platform: Callable[[str], PlatformConfig], database_url: str, monkeypatch: pytest.MonkeyPatch
) -> Iterator[list[C2Service]]:
    """Two c2 with one archive that both reply to a query, as for a short time after an outage of the database."""
    monkeypatch.setattr(C2Service, "_prefer_others", lambda *_, **__: None)
    pair = [C2Service(platform(f"shore-{n}"), C2Config(database=database_url, json_mirror=True)) for n in range(1, 3)]
    for service in pair:
        assert service.start()
        service._queries.set_preferred(is_preferred=False)
    yield pair
    for service in pair:
        service.stop()


def accept(c2: C2Service, *records: ReconstructedImage | Decision) -> None:
    before = c2.health().counters.get("records_handled", 0)
    for record in records:
        is_image = isinstance(record, ReconstructedImage)
        key = keys.image_reconstructed("vessel-1") if is_image else keys.contact_decision("vessel-1")
        envelope = Relayed(vessel_id="vessel-1", key=key, payload=wire.encode(record), relayed_utc_s=1.0)
        c2.session.put(keys.shore_inbox("vessel-1"), wire.encode(envelope))
    eventually(lambda: c2.health().counters.get("records_handled", 0) == before + len(records), what="acceptance")


def rust_program() -> str:
    folder = Path(os.environ.get("SONARPOST_EXAMPLES_TARGET", EXAMPLES / "rust" / "target"))
    for kind in ("release", "debug"):
        if (folder / kind / "catch_up").is_file():
            return str(folder / kind / "catch_up")
    pytest.skip("examples/rust has not been built")


def check(c2: C2Service, start: Callable[[str], Program]) -> None:
    """Check a program: 300 records missed, then new ones, a repeated one, then a restart with a cursor."""
    c2._accepted.number([c2._accepted.image(image(f"{n:04X}"), "") for n in range(1, 301)])
    program = start("")
    lines = program.read(300)
    assert lines == [f"{n} reconstructed_image uuv-1 {n:04X} 1 -" for n in range(1, 301)]
    accept(c2, image("0AAA"), image("0001"), decision("0AAA", verdict="mine_like"))
    assert program.read(2) == ["301 reconstructed_image uuv-1 0AAA 1 -", "302 decision uuv-1 0AAA - mine_like"]
    program.stop()
    assert program.lines.empty()
    archive = c2._accepted.journal().archive
    accept(c2, image("0BBB"))
    again = start(f"{archive}.301")
    assert again.read(2) == ["302 decision uuv-1 0AAA - mine_like", "303 reconstructed_image uuv-1 0BBB 1 -"]
    again.stop()
    refused = start("00000000.5")
    assert refused.process.wait(120) == 1
    assert refused.process.stderr is not None
    assert "after: got '00000000.5', expected a cursor of" in refused.process.stderr.read()


def check_pair(pair: list[C2Service], start: Callable[[str], Program]) -> None:
    """Check a program with two c2: 300 records missed, half of each c2, then one of them ends."""
    for first in range(1, 301, 10):
        service = pair[first // 10 % 2]
        service._accepted.number([service._accepted.image(image(f"{n:04X}"), "") for n in range(first, first + 10)])
    lines = [f"{n} reconstructed_image uuv-1 {n:04X} 1 -" for n in range(1, 301)]
    program = start("")
    assert program.read(300) == lines
    pair[0].stop()
    accept(pair[1], image("0AAA"))
    lines.append("301 reconstructed_image uuv-1 0AAA 1 -")
    assert program.read(1) == lines[-1:]
    late = start("")
    assert late.read(301) == lines
    for each in (program, late):
        each.stop()
        assert each.lines.empty()


def test_python(run: Run, c2: C2Service, router: str, tmp_path: Path) -> None:
    text = PYTHON.read_text()
    modules = set(re.findall(r"^(?:import|from) (\w+)", text, re.MULTILINE))
    assert modules - set(sys.stdlib_module_names) == {"zenoh", "msgpack"}
    saved = tmp_path / "cursor"

    def start(cursor: str) -> Program:
        saved.write_text(cursor)
        return run(sys.executable, "-I", str(PYTHON), router, str(saved))

    check(c2, start)


def test_python_with_two_c2(run: Run, pair: list[C2Service], router: str) -> None:
    check_pair(pair, lambda _: run(sys.executable, "-I", str(PYTHON), router))


def test_rust(run: Run, c2: C2Service, router: str) -> None:
    program = rust_program()
    check(c2, lambda cursor: run(program, router, cursor))


def test_rust_with_two_c2(run: Run, pair: list[C2Service], router: str) -> None:
    program = rust_program()
    check_pair(pair, lambda _: run(program, router))


def test_javascript(run: Run, c2: C2Service, client: zenoh.Session) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    with rest_interface(client) as server:
        check(c2, lambda cursor: run(node, str(JAVASCRIPT), server, cursor))


def test_javascript_with_two_c2(run: Run, pair: list[C2Service], client: zenoh.Session) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    with rest_interface(client) as server:
        check_pair(pair, lambda _: run(node, str(JAVASCRIPT), server))
