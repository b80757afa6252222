"""docs/reference/exports.md: every property is listed, and the program runs."""

from __future__ import annotations

import re
import socket
import threading
from pathlib import Path

import pytest
from builders.common import REPOSITORY
from builders.exports import mission

from sonarpost.export.tables import COLUMNS

PAGE = (REPOSITORY / "docs" / "reference" / "exports.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def test_all_properties_are_documented() -> None:
    cells = [line.split("|")[1] for line in section("Contents").splitlines() if line.startswith("| `")]
    named = [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    assert sorted(named) == sorted(COLUMNS)


def test_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    mission(tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r"```python\n(.*?)```", section("From Python"), re.DOTALL)
    received = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def receive() -> None:
            connection = listener.accept()[0]
            with connection:
                while data := connection.recv(65536):
                    received.extend(data)

        thread = threading.Thread(target=receive)
        thread.start()
        exec(program.replace("tak.example:8087", f"127.0.0.1:{listener.getsockname()[1]}"), {})
        thread.join(10)
    assert received.count(b"<event ") == 5
    assert {path.name for path in tmp_path.glob("contacts.*")} == {
        f"contacts.{s}" for s in ("geojson", "kml", "kmz", "csv")
    }
    assert capsys.readouterr().out == ""
