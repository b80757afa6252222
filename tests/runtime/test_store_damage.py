"""A service whose store was damaged or has lost commits: refused at the start, or degraded until it is cleared."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from sonarpost.cli.main import main as sonarpost
from sonarpost.config import PlatformConfig
from sonarpost.runtime.process import EXIT_CONFIG, main
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

PAGE = 4096


@pytest.fixture(autouse=True)
def umask() -> Iterator[None]:
    """Restore the umask, which the main function of a service changes."""
    before = os.umask(0o022)
    os.umask(before)
    yield
    os.umask(before)


def test_lost_commits_degrade_the_service_until_they_are_cleared(
    platform: Callable[[str], PlatformConfig], tmp_path: Path
) -> None:
    def health() -> tuple[str, str]:
        service = RelayService(platform("vessel-1"), RelayConfig())
        found = service.health()
        service.stop()
        return found.state, found.detail

    service = RelayService(platform("vessel-1"), RelayConfig())
    path = service.store.path
    with service.store.transaction() as tx:
        for number in range(30):
            tx.send("k", "c2", b"%d" % number, encoding="e")
    service.stop()
    assert health() == ("ok", "")
    path.write_bytes(b"")
    expected = "commits of relay.db are lost; records possibly lost: c2 30; see `sonarpost store check`"
    for _ in range(2):
        assert health() == ("degraded", expected)
    assert sonarpost(["store", "check", str(path), "--clear"]) == 0
    assert health() == ("ok", "")


def test_damaged_store_is_refused_with_the_command_that_recovers_it(
    platform: Callable[[str], PlatformConfig], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    vessel = platform("vessel-1")
    service = RelayService(vessel, RelayConfig())
    path = service.store.path
    with service.store.transaction() as tx:
        for number in range(100):
            tx.send("k", "c2", b"%d" % number * 500, encoding="e")
    service.stop()
    with path.open("r+b") as file:
        file.seek((path.stat().st_size // PAGE - 5) * PAGE)
        file.write(b"\xa5" * PAGE)
    config = tmp_path / "vessel.toml"
    config.write_text(
        f'[platform]\nid = "vessel-1"\nrouter = ["{vessel.router[0]}"]\nstate_dir = "{vessel.state_dir}"\n'
    )
    assert main(RelayService, RelayConfig, ["--config", str(config)]) == EXIT_CONFIG
    lines = [line for line in capfd.readouterr().err.splitlines() if "Service cannot start" in line]
    assert len(lines) == 1
    assert f"sonarpost store salvage {path} --out NEW" in lines[0]
