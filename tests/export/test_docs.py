"""The program in docs/reference/exports.md runs."""

from __future__ import annotations

import re
import socket
import threading

import pytest
from builders.common import REPOSITORY
from builders.exports import mission

PAGE = (REPOSITORY / "docs" / "reference" / "exports.md").read_text(encoding="utf-8")


@pytest.mark.system
def test_example_runs(tmp_path, monkeypatch, capsys):
    mission(tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r"```python\n(.*?)```", PAGE.split("\n## From Python\n")[1], re.DOTALL)
    received = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def receive():
            connection = listener.accept()[0]
            with connection:
                while data := connection.recv(65536):
                    received.extend(data)

        thread = threading.Thread(target=receive)
        thread.start()
        exec(program.replace("tak.example:8087", f"127.0.0.1:{listener.getsockname()[1]}"), {})
        thread.join()
    assert received.count(b"<event ") == 5
    assert {path.suffix for path in tmp_path.glob("contacts.*")} == {".geojson", ".kml", ".kmz", ".csv"}
    assert capsys.readouterr().out == ""
