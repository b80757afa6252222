"""docs/reference/exports.md agrees with the code: properties, event types, and a program that runs."""

from __future__ import annotations

import re
import socket
import threading
from pathlib import Path

import pytest
from builders.common import REPOSITORY
from builders.exports import mission

from sonarpost.export.cot import BOTTOM_RETURN, MINE_POSITIONS, SPOT
from sonarpost.export.tables import COLUMNS

PAGE = (REPOSITORY / "docs" / "reference" / "exports.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def test_all_properties_are_documented() -> None:
    cells = [line.split("|")[1] for line in section("What is exported").splitlines() if line.startswith("| `")]
    named = [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    assert sorted(named) == sorted(COLUMNS)


def test_event_types_and_mine_classes_are_documented() -> None:
    text = section("Cursor-on-Target")
    assert f"| `{SPOT}` |" in text
    assert f"| `{BOTTOM_RETURN}` |" in text
    documented = {}
    for classes, position in re.findall(r"((?:\*[\w ]+\*(?:,\s)?)+) →\s`(\w)`", text):
        documented |= dict.fromkeys(re.findall(r"\*([\w ]+)\*", classes), position)
    assert documented == dict(MINE_POSITIONS)


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
