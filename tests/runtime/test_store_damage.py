"""A service whose store has lost commits, or states that cannot be read, is degraded."""

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


def test_unreadable_state_degrades_the_service_until_the_next_start(platform):
    service = RelayService(platform("vessel-1"), RelayConfig())
    with service.store.transaction() as tx:
        tx.put_state("name", b"not a number")
    assert service.store.read_state("name", int, 0) == 0
    found = service.health()
    service.stop()
    reason = "stored states discarded since the start: 1; they are in the quarantine"
    assert (found.state, found.detail, found.counters["states_discarded"]) == ("degraded", reason, 1)
    service = RelayService(platform("vessel-1"), RelayConfig())
    found = service.health()
    service.stop()
    assert (found.state, found.gauges["refused"]) == ("ok", 1.0)
