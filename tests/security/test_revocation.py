"""A router that restarts with the new list denies a revoked certificate (docs/explanation/security.md)."""

import pytest
import zenoh
from builders.common import eventually

from sonarpost import keys
from sonarpost.bus.session import client_config

pytestmark = pytest.mark.system


def wait_until_received(shore_session, session, key):
    got: list[str] = []
    subscriber = shore_session.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))

    def put_and_received():
        session.put(key, b"")
        return key in got

    eventually(put_and_received, what=key)
    subscriber.undeclare()


def test_revoked_vessel_is_denied_and_reconnects_under_a_new_name(own_world):
    world = own_world
    key = "sonarpost/v1/vessel-2/test/a"
    wanted = world.shore_wanted(world.shore_tls, world.shore_local)
    with world.open("vessel-2") as old, zenoh.open(client_config([world.shore_local])) as shore_session:
        wait_until_received(shore_session, old, key)

        world.fleet.revoke("vessel-2", "laptop stolen")
        world.shore.stop()
        restarted = world.start("shore-1", wanted)
        # The session with the stolen certificate reconnects by itself and is logged.
        restarted.wait_for("Peer denied by access control", "peer=vessel-2 ")
        eventually(lambda: len(shore_session.info.routers_zid()) == 1, what="c2's session reconnected")
        got: list[str] = []
        shore_session.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))
        with world.open("vessel-1") as other:
            wait_until_received(shore_session, other, "sonarpost/v1/vessel-1/test/before")
            old.put(key, b"stolen")
            assert list(old.get(keys.presence_any("vessel-2"), timeout=30)) == []
            wait_until_received(shore_session, other, "sonarpost/v1/vessel-1/test/after")
        assert key not in got

    folder = world.fleet.issue("vessel-2", "vessel").folder
    assert folder.name == "vessel-2.g2"
    world.folders["vessel-2.g2"] = folder
    restarted.stop()
    world.start("shore-1", wanted)
    with world.open("vessel-2.g2") as new, zenoh.open(client_config([world.shore_local])) as shore_session:
        wait_until_received(shore_session, new, key)
        [reply] = list(new.get(keys.presence_any("vessel-2"), timeout=30))
        assert reply.ok is not None
