"""Atomic file writes."""

import errno
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.files import PUBLIC_FILE, AtomicFiles, make_private, read_regular, write_atomically


def leftovers(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


@given(st.lists(st.binary(max_size=200), min_size=1, max_size=3))
def test_file_holds_the_last_version(tmp_path_factory, versions):
    folder = tmp_path_factory.mktemp("atomic")
    for data in versions:
        write_atomically(folder / "file.bin", data)
        assert (folder / "file.bin").read_bytes() == data
    assert [path.name for path in folder.iterdir()] == ["file.bin"]


@pytest.mark.parametrize(("umask", "expected"), [(0o022, 0o644), (0o077, 0o600)])
def test_umask_limits_the_permissions_unless_a_mode_is_given(umask, expected, tmp_path):
    files = AtomicFiles()
    before = os.umask(umask)
    try:
        write_atomically(tmp_path / "by umask", b"x")
        write_atomically(tmp_path / "given", b"x", PUBLIC_FILE)
        files.add(tmp_path / "staged", b"x")
        files.commit()
    finally:
        os.umask(before)
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert modes == {"by umask": expected, "given": 0o644, "staged": expected}


def test_existing_file_is_restricted_to_its_owner(tmp_path):
    (tmp_path / "old").write_text("x")
    (tmp_path / "old").chmod(0o644)
    for name in ("old", "new"):
        make_private(tmp_path / name)
        assert (tmp_path / name).stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "old").read_text() == "x"


@pytest.mark.parametrize("call", ["fsync", "fchmod", "write", "replace"])
def test_failed_write_keeps_the_old_file_only(call, tmp_path, monkeypatch):
    target = tmp_path / "f"
    target.write_bytes(b"old")

    def fail(*_args, **_more):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if call == "replace":
        monkeypatch.setattr(Path, "replace", fail)
    elif call == "write":

        class FullFile:
            def __init__(self, descriptor):
                self.descriptor = descriptor

            def __enter__(self):
                return self

            def __exit__(self, *_):
                os.close(self.descriptor)

            write = fail

        monkeypatch.setattr(os, "fdopen", lambda descriptor, _mode: FullFile(descriptor))
    else:
        monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(target, b"new", PUBLIC_FILE)
    monkeypatch.undo()
    assert target.read_bytes() == b"old"
    assert leftovers(tmp_path) == []


def test_folder_in_place_of_the_file_is_kept(tmp_path):
    (tmp_path / "f").mkdir()
    with pytest.raises(OSError, match="directory"):
        write_atomically(tmp_path / "f", b"x")
    assert (tmp_path / "f").is_dir()
    assert leftovers(tmp_path) == []


def test_data_is_flushed_before_the_rename_and_the_rename_before_the_return(tmp_path, monkeypatch):
    steps: list[str] = []
    sync, replace = os.fsync, Path.replace

    def fsync(descriptor):
        steps.append("sync folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "sync file")  # noqa: PTH112
        sync(descriptor)

    def rename(self, target):
        steps.append("rename")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", rename)
    write_atomically(tmp_path / "f", b"x")
    assert steps == ["sync file", "rename", "sync folder"]


def test_reader_never_sees_a_partial_file(tmp_path):
    target = tmp_path / "f"
    versions = [bytes([n]) * 20_000 for n in range(1, 40)]
    write_atomically(target, versions[0])
    stop = threading.Event()
    met: set[bytes] = set()

    def read():
        while not stop.is_set():
            met.add(target.read_bytes())

    reader = threading.Thread(target=read)
    reader.start()
    for data in versions:
        write_atomically(target, data)
    stop.set()
    reader.join()
    assert met
    assert met <= set(versions)


def test_killed_writer_leaves_a_complete_file(tmp_path):
    script = (
        "import sys, itertools; from pathlib import Path; from sonarpost.files import AtomicFiles, write_atomically\n"
        "for n in itertools.count(1):\n"
        "    write_atomically(Path(sys.argv[1]), str(n).encode() * 30000)\n"
        "    print(n, flush=True)\n"
    )
    target = tmp_path / "f"
    writer = subprocess.Popen([sys.executable, "-c", script, str(target)], stdout=subprocess.PIPE, text=True)
    try:
        assert writer.stdout is not None
        for _ in range(20):
            written = int(writer.stdout.readline())
    finally:
        writer.send_signal(signal.SIGKILL)
        writer.communicate()
    text = target.read_text()
    number = text[: len(text) // 30000]
    assert text == number * 30000
    assert int(number) >= written


def test_batch_is_renamed_together_with_the_last_files_last(tmp_path):
    files = AtomicFiles()
    files.add(tmp_path / "b", b"2", last=True)
    files.add(tmp_path / "a", b"1")
    assert [p.name for p in tmp_path.iterdir() if not p.name.startswith(".")] == []
    files.commit()
    assert sorted((p.name, p.read_bytes()) for p in tmp_path.iterdir()) == [("a", b"1"), ("b", b"2")]


def test_failed_batch_leaves_no_files(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"before")
    files = AtomicFiles()
    files.add(tmp_path / "a", b"1")
    files.add(tmp_path / "b", b"2", last=True)

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        files.commit()
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a", b"before")]
    assert len(files) == 0


def test_end_of_a_batch_can_be_discarded(tmp_path):
    files = AtomicFiles()
    files.add(tmp_path / "a", b"1")
    before = len(files)
    files.add(tmp_path / "b", b"2", last=True)
    files.drop_from(before)
    files.commit()
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_an_error_names_the_file_and_not_the_temporary_one(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        write_atomically(tmp_path / "absent" / "track.csv", b"")
    assert caught.value.filename == str(tmp_path / "absent" / "track.csv")


@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "loop", "absent", "zero byte", "large", "growing"])
def test_only_a_regular_file_of_limited_size_is_read(kind, tmp_path):
    path = tmp_path / "a"
    (tmp_path / "good").write_bytes(b"12345678")
    assert read_regular(tmp_path / "good", 8) == b"12345678"
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "zero byte":
            path = tmp_path / "a\0b"
        case "large":
            path.write_bytes(b"123456789")
        case "absent":
            pass
        case _:
            # Files in /proc have size 0 and content, as a file that grows.
            path.symlink_to({"device": "/dev/zero", "loop": "a", "growing": "/proc/self/status"}[kind])
    with pytest.raises(OSError, match=r".+"):
        read_regular(path, 8)
