"""Names of emulated serial ports: a host that waits for one never opens the terminal of another emulator."""

import os
import signal
import subprocess
import types

from builders import chain as chains

from sonarpost.extensions.simulation.channel import host_ports
from sonarpost.extensions.simulation.channel.host_ports import PtyPort


def test_link_is_removed_before_its_terminal_is_closed(tmp_path, monkeypatch):
    port = PtyPort(tmp_path / "modem-1")
    closed = []

    def close(descriptor):
        closed.append((tmp_path / "modem-1").is_symlink())
        os.close(descriptor)

    monkeypatch.setattr(host_ports, "os", types.SimpleNamespace(**{**vars(os), "close": close}))
    port.close()
    assert closed == [False]


def test_killed_emulator_leaves_no_link(tmp_path):
    (tmp_path / "modem-1").symlink_to("/dev/pts/0")
    with subprocess.Popen(["sleep", "60"]) as process:
        settings = types.SimpleNamespace(ports_folder=tmp_path)
        chain = types.SimpleNamespace(settings=settings, pid=lambda _name: process.pid)
        chains.send_signal(chain, "acoustic_channel", signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    assert list(tmp_path.iterdir()) == []
