"""Files of a service process: readable by its user only, whatever umask it inherits."""

import os
import signal
import subprocess
import sys

from builders.common import eventually
from builders.records import decision_record
from builders.shore import image, relayed

from sonarpost import keys
from sonarpost.cli.main import main
from sonarpost.delivery.store import Store


def modes(folder):
    paths = [folder, *folder.rglob("*")]
    return {str(path.relative_to(folder)): path.stat().st_mode & 0o777 for path in paths}


def assert_private(folder):
    """Require 0600 for every file and 0700 for every folder; return their names."""
    found = modes(folder)
    wrong = {name: oct(mode) for name, mode in found.items() if mode != (0o700 if (folder / name).is_dir() else 0o600)}
    assert wrong == {}
    return set(found)


def test_files_of_c2_are_readable_by_its_user_only(runner, platform, tmp_path, capsys):
    shore, out = platform("shore-1"), tmp_path / "deep" / "out"
    config = tmp_path / "shore.toml"
    config.write_text(
        f'[platform]\nid = "shore-1"\nrouter = ["{shore.router[0]}"]\nstate_dir = "{tmp_path}/deep/state"\n'
        f'[c2]\nout_dir = "{out}"\n'
    )
    command = [sys.executable, "-m", "sonarpost.services.c2", "--config", str(config)]
    process = subprocess.Popen(command, umask=0o022)
    try:
        relay = runner.peer("vessel-1", "relay")
        relay.send(keys.shore_inbox("vessel-1"), "c2", relayed(image()), relayed(decision_record()))
        eventually(lambda: len(list(out.glob("*/*.json"))) == 1 and len(list(out.glob("*/decisions/*.json"))) == 1)
        eventually(lambda: relay.store.outbox_depth() == 0)
        names = assert_private(tmp_path / "deep")
        assert names >= {f"state/c2.db{suffix}" for suffix in ("", "-wal", "-shm", ".lock", ".watermark")}
        assert names >= {"out/archive.db", "out/archive.db-wal", "out/vessel-1/decisions"}
        assert main(["c2", "ls", "--archive", str(out)]) == 0
        assert "1 images" in capsys.readouterr().out
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(120) == 0
    assert_private(tmp_path / "deep")


def test_store_that_others_can_read_is_restricted(tmp_path):
    path = tmp_path / "relay.db"
    Store(path).close()
    for each in tmp_path.iterdir():
        each.chmod(0o644)
    before = os.umask(0o022)
    try:
        store = Store(path)
        assert {name: mode for name, mode in modes(tmp_path).items() if name != "." and mode != 0o600} == {}
        store.close()
    finally:
        os.umask(before)
