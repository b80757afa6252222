"""Objects by name: those of the core, of extensions and of plug-ins."""

import logging
import sys
import types
from importlib.metadata import EntryPoint

import pytest

from sonarpost import registry
from sonarpost.errors import ConfigError
from sonarpost.registry import Registry

GROUP = "sonarpost.numbers"


@pytest.fixture
def numbers(monkeypatch):
    """Makes a registry of numbers from entry points, name to object of a module."""
    module = types.ModuleType("plug_in_numbers")
    module.ONE, module.TWO, module.TEXT = 1, 2, "two"
    monkeypatch.setitem(sys.modules, "plug_in_numbers", module)

    def make(**points):
        found = [EntryPoint(name, f"plug_in_numbers:{value}", GROUP) for name, value in points.items()]
        return Registry(GROUP, "a number", lambda each, _: isinstance(each, int), {"zero": 0}, found)

    return make


def test_object_is_imported_when_it_is_asked_for(numbers):
    found = numbers(one="ONE", broken="NONE", text="TEXT")
    assert found.names() == ("broken", "one", "text", "zero")
    assert (found.get("zero"), found.get("one")) == (0, 1)
    for name, expected in (("broken", "an object that imports"), ("text", "a number"), ("none", "one of broken, one")):
        with pytest.raises(ConfigError, match=f"sonarpost.numbers.*{expected}"):
            found.get(name)


def test_broken_plug_in_is_left_out_and_reported_once(numbers, caplog):
    found = numbers(one="ONE", broken="NONE", text="TEXT")
    with caplog.at_level(logging.WARNING):
        assert found.working() == found.working() == {"zero": 0, "one": 1}
    assert [*found.working()] == ["zero", "one"], "the core first"
    assert len(caplog.records) == 2
    assert "sonarpost.numbers:broken" in caplog.text


@pytest.mark.parametrize("last_line", ["sys.exit(7)", "raise KeyError(7)", "ONE = 1"])
def test_plug_in_that_prints_exits_or_raises_disturbs_no_output(last_line, monkeypatch, tmp_path, caplog, capsys):
    (tmp_path / "plug_in_that_prints.py").write_text(f"import sys\nprint('tried')\n{last_line}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "plug_in_that_prints", raising=False)
    found = Registry(GROUP, "a number", lambda *_: True, {}, [EntryPoint("prints", "plug_in_that_prints:ONE", GROUP)])
    expected = {"prints": 1} if last_line == "ONE = 1" else {}
    assert found.working() == found.working() == expected
    assert capsys.readouterr() == ("", "")
    assert caplog.text.count("Output at import of entry point sonarpost.numbers:prints: 'tried") == 1
    failure = "entry point sonarpost.numbers:prints: value: got 'plug_in_that_prints:ONE ("
    assert caplog.text.count(failure) == (0 if expected else 1)


def test_name_of_an_empty_registry():
    with pytest.raises(ConfigError, match="got 'one', expected an extension or a plug-in that has it"):
        Registry(GROUP, "a number", lambda *_: True, {}, []).get("one")


@pytest.mark.parametrize("content", [b"x = [", b"\xff\xfe", b'"sonarpost.numbers" = 3'])
def test_invalid_entry_points_of_an_extension_are_reported_once(content, monkeypatch, tmp_path, caplog):
    for name, written in (("broken", content), ("whole", b'["sonarpost.numbers"]\none = "a:ONE"\n')):
        (tmp_path / name).mkdir()
        (tmp_path / name / "entry_points.toml").write_bytes(written)
    monkeypatch.setattr(registry, "EXTENSIONS", tmp_path)
    registry.installed_points.cache_clear()
    try:
        assert [point.value for point in registry.installed_points(GROUP)] == ["a:ONE"]
        assert registry.installed_points("sonarpost.others") == ()
    finally:
        registry.installed_points.cache_clear()
    [record] = caplog.records
    assert str(tmp_path / "broken" / "entry_points.toml") in record.getMessage()


def test_damaged_metadata_of_a_package_hides_no_other(monkeypatch, tmp_path, caplog):
    contents = {"damaged": b"[sonarpost.commands]\nneither name nor value\n", "binary": b"\xff\xfe"}
    for name, content in {**contents, "whole": b"[sonarpost.commands]\nwhole = a:ONE\n"}.items():
        metadata = tmp_path / f"{name}-1.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
        (metadata / "entry_points.txt").write_bytes(content)
    monkeypatch.syspath_prepend(tmp_path)
    registry.installed_points.cache_clear()
    registry._plug_in_points.cache_clear()
    try:
        found = registry.installed_points("sonarpost.commands")
        assert registry.installed_points("sonarpost.others") == ()
    finally:
        registry.installed_points.cache_clear()
        registry._plug_in_points.cache_clear()
    assert [point for point in found if point.name != "whole"] == registry._extension_points("sonarpost.commands")
    assert [point.value for point in found if point.name == "whole"] == ["a:ONE"]
    assert caplog.text.count("Plug-ins ignored: metadata of an installed package: ") == len(contents)


def test_core_has_priority(numbers, caplog):
    assert numbers(zero="ONE").get("zero") == 0
    assert "its name is taken: sonarpost.numbers:zero = plug_in_numbers:ONE" in caplog.text


def test_extension_is_found_by_its_folder_and_has_priority(monkeypatch, tmp_path):
    for name, value in (("b", "b:TWO"), ("a", "a:ONE")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "entry_points.toml").write_text(f'["{GROUP}"]\n"{name} of" = "{value}"\n')
    (tmp_path / "empty").mkdir()
    installed = EntryPoint("a", "plug_in:A", GROUP)
    monkeypatch.setattr(registry, "EXTENSIONS", tmp_path)
    monkeypatch.setattr(registry, "_plug_in_points", lambda: (installed,))
    registry.installed_points.cache_clear()
    try:
        found = registry.installed_points(GROUP)
        assert [point.value for point in found] == ["a:ONE", "b:TWO", "plug_in:A"]
        assert registry.installed_points("sonarpost.others") == ()
    finally:
        registry.installed_points.cache_clear()
