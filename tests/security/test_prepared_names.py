"""Names prepared in advance: a new vessel is admitted by a router that runs, in this process."""

import time
from pathlib import PurePosixPath

import pytest
import zenoh
from builders.common import eventually, free_port
from builders.fleet_certificates import tls_of

from sonarpost import keys
from sonarpost.bus.session import client_config
from sonarpost.cli.main import main
from sonarpost.errors import BadInputError
from sonarpost.security.fleet import Fleet, PkiError
from sonarpost.security.router_config import RouterOptions, router_json5


@pytest.fixture
def fleet(tmp_path):
    return Fleet.init(tmp_path / "fleet", "test")


def test_vessel_with_a_prepared_name_joins_without_a_restart_of_the_router(fleet):
    shore = fleet.issue("shore-1", "shore", ["127.0.0.1"])
    fleet.prepare(["vessel-2", "vessel-3"], "vessel")
    port = free_port()
    endpoint = f"tls/127.0.0.1:{port}"
    options = RouterOptions("shore-1", [endpoint], [f"tcp/127.0.0.1:{free_port()}"], files=PurePosixPath(shore.folder))
    text = router_json5(fleet.index(), options, time.time())
    router = zenoh.open(zenoh.Config.from_json5(text))
    sessions = []
    try:
        received = []
        watcher = zenoh.open(client_config(list(options.local)))
        sessions.append(watcher)
        watcher.declare_subscriber(keys.everything(), lambda sample: received.append(str(sample.key_expr)))
        # Issued while the router runs; vessel-9 is not in its list.
        for platform in ("vessel-2", "vessel-9"):
            files = fleet.issue(platform, "vessel").folder
            session = zenoh.open(client_config([endpoint], tls_of(files)))
            sessions.append(session)
            publisher = session.declare_publisher(keys.health(platform, "relay"))
            if platform == "vessel-2":
                eventually(lambda publisher=publisher: publisher.matching_status.matching)
                publisher.put(b"x")
                session.put(keys.health("vessel-3", "relay"), b"forged")
                eventually(lambda: received == [keys.health("vessel-2", "relay")])
            else:
                publisher.put(b"x")
        sessions[1].put(keys.health("vessel-2", "last"), b"x")
        eventually(lambda: len(received) == 2)
        assert received[1] == keys.health("vessel-2", "last")
    finally:
        for session in sessions:
            session.close()
        router.close()


def test_prepared_name_is_for_one_role_and_a_new_platform(fleet):
    fleet.issue("shore-1", "shore")
    fleet.prepare(["vessel-2"], "vessel")
    fleet.prepare(["vessel-2"], "vessel")
    with pytest.raises(PkiError, match="role for which it is prepared"):
        fleet.issue("vessel-2", "shore")
    with pytest.raises(PkiError, match="role for which it is prepared"):
        fleet.prepare(["vessel-2"], "console")
    with pytest.raises(PkiError, match="a new platform"):
        fleet.prepare(["shore-1"], "shore")
    with pytest.raises(BadInputError):
        fleet.prepare(["Vessel 3"], "vessel")
    assert [name.common_name for name in fleet.index().allowed("vessel")] == ["vessel-2"]


def test_revoked_name_is_not_admitted_because_it_was_prepared(fleet):
    fleet.prepare(["vessel-2"], "vessel")
    fleet.issue("vessel-2", "vessel")
    fleet.revoke("vessel-2", "lost")
    assert fleet.index().allowed("vessel") == []


def test_command_prepares_and_says_what_to_do(fleet, capsys):
    assert main(["pki", "prepare", "vessel-2", "vessel-3", "--role", "vessel", "--dir", str(fleet.folder)]) == 0
    assert "vessel-2, vessel-3" in capsys.readouterr().out
    assert main(["pki", "issue", "vessel-2", "--role", "vessel", "--dir", str(fleet.folder)]) == 0
    assert "admit it" in capsys.readouterr().out
