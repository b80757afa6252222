"""A revoked certificate is refused once the router has restarted with the new list (docs/explanation/security.md)."""

from __future__ import annotations

import zenoh
from builders.common import eventually

from sonarpost import keys
from sonarpost.bus.session import client_config


def arrives(world, ashore: zenoh.Session, session: zenoh.Session, key: str) -> None:
    got: list[str] = []
    subscriber = ashore.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))

    def put_and_heard() -> bool:
        session.put(key, b"")
        return key in got

    eventually(put_and_heard, what=key)
    subscriber.undeclare()


def test_a_vessel_that_worked_is_cut_off_by_its_revocation_and_comes_back_under_a_new_name(world):
    key = "sonarpost/v1/vessel-2/test/a"
    wanted = world.shore_wanted(world.shore_tls, world.shore_local)
    with world.open("vessel-2") as old, zenoh.open(client_config([world.shore_local])) as ashore:
        arrives(world, ashore, old, key)

        world.fleet.revoke("vessel-2", "laptop stolen")
        world.shore.stop()
        restarted = world.start("shore-1", wanted)
        # The thief's session finds back to the router by itself, and is told of.
        restarted.wait_for("A peer is on no list", "peer=vessel-2 ")
        eventually(lambda: len(ashore.info.routers_zid()) == 1, what="c2's session back at the router")
        got: list[str] = []
        ashore.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))
        with world.open("vessel-1") as other:
            arrives(world, ashore, other, "sonarpost/v1/vessel-1/test/before")
            old.put(key, b"stolen")
            assert list(old.get(keys.hello_from_anybody("vessel-2"), timeout=3)) == []
            arrives(world, ashore, other, "sonarpost/v1/vessel-1/test/after")
        assert key not in got

    folder = world.fleet.issue("vessel-2", "vessel").folder
    assert folder.name == "vessel-2.g2"
    world.folders["vessel-2.g2"] = folder
    restarted.stop()
    world.start("shore-1", wanted)
    with world.open("vessel-2.g2") as new, zenoh.open(client_config([world.shore_local])) as ashore:
        arrives(world, ashore, new, key)
        [reply] = list(new.get(keys.hello_from_anybody("vessel-2"), timeout=3))
        assert reply.ok is not None
