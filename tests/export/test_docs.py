"""docs/reference/exports.md says what the code does: properties, types, and a program that runs."""

from __future__ import annotations

import re
import socket
import threading
from pathlib import Path

import pytest
from builders.common import REPOSITORY
from builders.exports import mission

from sonarpost.export.cot import BOTTOM_RETURN, MINE_POSITIONS, SPOT
from sonarpost.export.properties import COLUMNS

PAGE = (REPOSITORY / "docs" / "reference" / "exports.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def test_every_property_is_there_in_its_order() -> None:
    cells = [line.split("|")[1] for line in section("What is exported").splitlines() if line.startswith("| `")]
    named = [name for cell in cells for name in re.findall(r"`(\w+)`", cell)]
    assert sorted(named) == sorted(COLUMNS)


def test_types_and_words_are_those_of_the_code() -> None:
    text = section("Cursor-on-Target")
    assert f"| `{SPOT}` |" in text
    assert f"| `{BOTTOM_RETURN}` |" in text
    told = {}
    for words, position in re.findall(r"((?:\*[\w ]+\*(?:,\s)?)+) →\s`(\w)`", text):
        told |= dict.fromkeys(re.findall(r"\*([\w ]+)\*", words), position)
    assert told == dict(MINE_POSITIONS)


def test_the_program_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    mission(tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r"```python\n(.*?)```", section("From Python"), re.DOTALL)
    heard = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def listen() -> None:
            connection = listener.accept()[0]
            with connection:
                while data := connection.recv(65536):
                    heard.extend(data)

        thread = threading.Thread(target=listen)
        thread.start()
        exec(program.replace("tak.example:8087", f"127.0.0.1:{listener.getsockname()[1]}"), {})
        thread.join(10)
    assert heard.count(b"<event ") == 5
    assert {path.name for path in tmp_path.glob("contacts.*")} == {
        f"contacts.{s}" for s in ("geojson", "kml", "kmz", "csv")
    }
    assert capsys.readouterr().out == ""
