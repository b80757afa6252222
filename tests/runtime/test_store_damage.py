"""A service whose store has lost commits is degraded until it is cleared."""

from __future__ import annotations

from sonarpost.cli.main import main as sonarpost
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService


def test_lost_commits_degrade_the_service_until_they_are_cleared(platform):
    def health():
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
