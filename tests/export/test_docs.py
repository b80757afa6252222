"""The program in docs/reference/exports.md runs."""

import re

import pytest
from builders.common import REPOSITORY
from builders.exports import mission

PAGE = (REPOSITORY / "docs" / "reference" / "exports.md").read_text(encoding="utf-8")


@pytest.mark.system
def test_example_runs(tmp_path, monkeypatch, capsys):
    mission(tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r"```python\n(.*?)```", PAGE.split("\n## From Python\n")[1], re.DOTALL)
    exec(program, {})
    assert {path.suffix for path in tmp_path.glob("contacts.*")} == {".geojson", ".kml", ".kmz", ".csv"}
    assert capsys.readouterr().out == ""
