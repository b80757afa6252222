"""Storage of machine code: damaged files, a full disk, and the order of the folders."""

import errno
import importlib.util
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from numba.core import caching

from sonarpost.codec import code_cache, jit
from sonarpost.codec.code_cache import code_folders

SOURCE = """
from sonarpost.codec.jit import jit

def add_one(number):
    return number + 1

add_one = jit(add_one)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], object]]:
    """Import a module with a compiled function, each time as a new process would."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    path = tmp_path / "source" / "compiled_sample.py"
    path.parent.mkdir()
    path.write_text(SOURCE)

    def load() -> object:
        spec = importlib.util.spec_from_file_location("compiled_sample", path)
        assert spec is not None
        assert spec.loader is not None
        loaded = importlib.util.module_from_spec(spec)
        sys.modules["compiled_sample"] = loaded
        spec.loader.exec_module(loaded)
        return loaded.add_one

    yield load
    del sys.modules["compiled_sample"]


def hits(function) -> int:
    return sum(function.stats.cache_hits.values())


def test_machine_code_is_stored_beside_the_module_and_loaded_again(module, tmp_path) -> None:
    first = module()
    assert (first(1), hits(first)) == (2, 0)
    assert len(list((tmp_path / "source" / "__pycache__").glob("*.nbc"))) == 1
    second = module()
    assert (second(1), hits(second)) == (2, 1)


@pytest.mark.parametrize(("imports", "loaded"), [("from sonarpost.codec.jit import jit", 0), ("", 1)])
def test_a_change_of_another_compiled_module_of_the_folder_compiles_again(imports, loaded, module, tmp_path) -> None:
    other = tmp_path / "source" / "other.py"
    module()(1)
    other.write_text(imports)
    code_cache._digest.cache_clear()  # a new process reads the sources again
    changed = module()
    assert (changed(1), hits(changed)) == (2, loaded)


@pytest.mark.parametrize(
    ("damaged", "content"), [("*.nbi", b""), ("*.nbi", b"\x80\x04junk"), ("*.nbc", b"\x80\x04junk")]
)
def test_a_damaged_file_is_replaced(damaged, content, module, tmp_path, caplog) -> None:
    module()(1)
    [path] = (tmp_path / "source" / "__pycache__").glob(damaged)
    path.write_bytes(content)
    repaired = module()
    assert (repaired(1), hits(repaired)) == (2, 0)
    assert "cannot be read; it is compiled again" in caplog.text
    loaded = module()
    assert (loaded(1), hits(loaded)) == (2, 1)


def test_a_full_disk_leaves_the_machine_code_in_memory(module, monkeypatch, caplog) -> None:
    def full(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(caching.IndexDataCacheFile, "save", full)
    assert module()(1) == 2
    [record] = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert "No space left on device" in record.getMessage()


@pytest.fixture
def no_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NUMBA_CACHE_DIR", "CACHE_DIRECTORY", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(jit, "service_folders", [])


@pytest.mark.usefixtures("no_folders")
def test_folders_are_tried_in_a_documented_order(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    jit.use_code_folder(tmp_path / "state")
    source = tmp_path / "installed" / "codec" / "kernel.py"
    beside, service, user = code_folders(source)
    assert beside == source.parent / "__pycache__"
    assert [service.parent, user.parent] == [tmp_path / "state" / "machine-code", tmp_path / "user" / "sonarpost"]
    monkeypatch.setattr(jit, "service_folders", [])
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "cache"))
    jit.use_code_folder(tmp_path / "state")
    assert jit.service_folders == [tmp_path / "cache" / "machine-code"]  # the one of systemd


def test_a_chosen_folder_replaces_all_others_and_holds_several_installations(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "chosen"))
    [one] = code_folders(tmp_path / "one" / "codec" / "kernel.py")
    [other] = code_folders(tmp_path / "other" / "codec" / "kernel.py")
    assert one != other
    assert {one.parent, other.parent} == {tmp_path / "chosen"}


@pytest.mark.usefixtures("no_folders")
def test_a_user_without_a_home_has_no_user_folder(monkeypatch) -> None:
    monkeypatch.setattr("os.path.expanduser", lambda path: path)
    assert code_folders(Path("/opt/codec/kernel.py")) == [Path("/opt/codec/__pycache__")]
