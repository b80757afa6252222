"""Who has no business here gets nothing in and nothing out, and the router's log says so."""

from __future__ import annotations

import os

import pytest
import zenoh
from builders.common import eventually, free_port
from builders.fleet_certificates import tls_of

from sonarpost import keys, wire
from sonarpost.bus.connectivity import ConnectivityState, probe_endpoint
from sonarpost.bus.session import client_config
from sonarpost.messages import Health
from sonarpost.security.router_config import Wanted

INBOX_1 = keys.shore_inbox("vessel-1")
INBOX_2 = keys.shore_inbox("vessel-2")


class Heard:
    """What a session ashore hears of everything, and which hand-overs reach it."""

    def __init__(self, session: zenoh.Session) -> None:
        self.keys: list[str] = []
        self.queries: list[str] = []
        self.tokens: list[str] = []
        session.declare_subscriber("sonarpost/**", lambda sample: self.keys.append(str(sample.key_expr)))
        session.declare_queryable(keys.delivery_query(keys.shore_inbox_all(), "c2"), self._answer)
        session.liveliness().declare_subscriber(
            "sonarpost/**", lambda sample: self.tokens.append(str(sample.key_expr)), history=True
        )

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            self.queries.append(str(query.key_expr))
            query.reply(query.key_expr, b"answer")


@pytest.fixture
def heard(ashore: zenoh.Session) -> Heard:
    return Heard(ashore)


def answers(session: zenoh.Session, key: str) -> list[bytes]:
    return [reply.ok.payload.to_bytes() for reply in session.get(key, timeout=3) if reply.ok is not None]


def own_key_arrives(session: zenoh.Session, heard: Heard, vessel: str, note: str) -> None:
    """What a session sent before this has arrived by now, if it ever does: a link keeps order."""
    key = f"{keys.everything_of(vessel)[:-2]}test/{note}"

    def put_and_heard() -> bool:
        # Again and again, as what is sent before the subscription is known goes nowhere.
        session.put(key, b"")
        return key in heard.keys

    eventually(put_and_heard, what=key)


@pytest.mark.parametrize(
    ("who", "reason"),
    [("", "peer sent no certificates"), ("stranger", "UnknownIssuer"), ("expired", "certificate expired")],
)
def test_without_a_valid_certificate_of_the_fleet_nobody_connects(world, who, reason):
    config = client_config([world.shore_tls], world.tls(who or "vessel-2"))
    if who == "stranger":
        config.insert_json5("transport/link/tls/root_ca_certificate", f'"{world.fleet.folder / "ca.pem"}"')
    if not who:
        config.insert_json5("transport/link/tls/enable_mtls", "false")
        for name in ("connect_private_key", "connect_certificate"):
            config.insert_json5(f"transport/link/tls/{name}", "null")
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)
    world.shore.wait_for("TLS connection refused", reason)


def test_a_server_under_a_wrong_name_is_not_linked_to(world):
    endpoint = f"tls/localhost:{free_port()}"
    wanted = Wanted("shore-2", listen=[endpoint], local=[], files=world.folders["nameless"])
    router = world.start("shore-2", wanted)
    outcome = probe_endpoint(endpoint, world.tls("vessel-2"))
    assert outcome.reach is ConnectivityState.TLS_REFUSED
    assert "localhost" in outcome.detail
    with pytest.raises(zenoh.ZError):
        world.open("vessel-2", endpoint=endpoint)
    router.wait_for("TLS connection refused", "fatal alert")


def test_a_vessel_writes_under_its_own_prefix_only(world, heard):
    foreign = ["sonarpost/v1/vessel-2/acoustic/rx", "sonarpost/v1/shore/contact/vessel-2/image", INBOX_2, "other/key"]
    with world.open("vessel-1") as rogue:
        own_key_arrives(rogue, heard, "vessel-1", "before-writes")
        for key in foreign:
            rogue.put(key, b"false")
        rogue.delete("sonarpost/v1/vessel-2/acoustic/rx")
        own_key_arrives(rogue, heard, "vessel-1", "writes")
    assert not set(foreign) & set(heard.keys)
    for key in foreign:
        world.shore.wait_for("Message denied", "peer=vessel-1", "message=Put", f"key={key}")
    world.shore.wait_for("Message denied", "peer=vessel-1", "message=Delete")


@pytest.mark.parametrize("mode", ["peer", "router"])
def test_it_is_no_use_to_come_as_a_peer_or_a_router(world, heard, mode):
    key = f"sonarpost/v1/vessel-2/as-{mode}"
    with world.open("vessel-1", mode) as rogue:
        # A session of this kind sends what it knows a listener for.
        own_key_arrives(rogue, heard, "vessel-1", f"before-{mode}")
        rogue.put(key, b"false")
        own_key_arrives(rogue, heard, "vessel-1", f"as-{mode}")
    assert key not in heard.keys
    world.shore.wait_for("Message denied", "peer=vessel-1", f"key={key}")


def test_a_vessel_hands_over_to_its_own_inbox_only(world, heard):
    with world.open("vessel-1") as rogue:
        eventually(lambda: answers(rogue, keys.delivery_query(INBOX_1, "c2")) == [b"answer"], what="the own hand-over")
        assert answers(rogue, keys.delivery_query(INBOX_2, "c2")) == []
        assert answers(rogue, keys.delivery_query(keys.shore_inbox_all(), "c2")) == []
        assert answers(rogue, "sonarpost/**") == []
    assert {key for key in heard.queries if "vessel-1" not in key} == set()
    world.shore.wait_for(
        "Message denied", "peer=vessel-1", "message=Query", f"key={keys.delivery_query(INBOX_2, 'c2')}"
    )


def test_a_vessel_answers_for_itself_only(world, ashore, heard):
    with world.open("vessel-1") as rogue:
        for vessel in ("vessel-1", "vessel-2"):
            rogue.declare_queryable(
                keys.delivery_query(keys.advice(vessel), "relay"), lambda query: query.reply(query.key_expr, b"mine")
            )
        own = keys.delivery_query(keys.advice("vessel-1"), "relay")
        eventually(lambda: answers(ashore, own) == [b"mine"], what="its own answer")
        assert answers(ashore, keys.delivery_query(keys.advice("vessel-2"), "relay")) == []
    world.shore.wait_for("Message denied", "peer=vessel-1", "Queryable", "vessel-2/advice/handoff/relay")


def test_a_vessel_hears_its_own_prefix_only(world, ashore):
    got: list[str] = []
    with world.open("vessel-1") as rogue:
        for key in ("sonarpost/v1/vessel-2/**", "sonarpost/v1/shore/**", "sonarpost/**", "**", keys.advice("vessel-1")):
            rogue.declare_subscriber(key, lambda sample: got.append(str(sample.key_expr)))

        def put_and_got() -> bool:
            ashore.put("sonarpost/v1/vessel-2/acoustic/rx", b"secret")
            ashore.put(keys.shore_image("vessel-2"), b"secret")
            ashore.put(keys.advice("vessel-1"), b"for it")
            return keys.advice("vessel-1") in got

        eventually(put_and_got, what="its own key")
    assert set(got) == {keys.advice("vessel-1")}
    world.shore.wait_for("Message denied", "peer=vessel-1", "Subscriber", "key=sonarpost/v1/vessel-2/**")


def test_a_vessel_neither_pretends_nor_sees_that_another_is_alive(world, ashore, heard):
    false, true = keys.alive("vessel-2", "relay-false"), keys.alive("vessel-1", "relay-true")
    token = ashore.liveliness().declare_token(keys.alive("vessel-2", "relay"))
    with world.open("vessel-1") as rogue:
        tokens = [rogue.liveliness().declare_token(key) for key in (false, true)]
        eventually(lambda: true in heard.tokens, what="its own token")
        assert false not in heard.tokens
        # A session knows its own tokens; it is the other's that it must not see.
        seen = {str(reply.ok.key_expr) for reply in rogue.liveliness().get("sonarpost/v1/*/alive/*") if reply.ok}
        assert seen <= {false, true}
        del tokens
    token.undeclare()
    world.shore.wait_for("Message denied", "peer=vessel-1", "Liveliness Token", f"key={false}")


def test_a_revoked_certificate_gets_nothing_through_and_the_new_one_does(world, heard):
    with world.open("vessel-3") as rogue, world.open("vessel-3.g2") as honest:
        own_key_arrives(honest, heard, "vessel-3", "before")
        rogue.put("sonarpost/v1/vessel-3/acoustic/rx", b"stolen")
        assert answers(rogue, keys.delivery_query(keys.shore_inbox("vessel-3"), "c2")) == []
        rogue.liveliness().declare_token(keys.alive("vessel-3", "relay"))
        publisher = rogue.declare_publisher("sonarpost/v1/vessel-3/acoustic/rx")
        own_key_arrives(honest, heard, "vessel-3", "honest")
        assert answers(honest, keys.delivery_query(keys.shore_inbox("vessel-3"), "c2")) == [b"answer"]
        assert not publisher.matching_status.matching
    assert "sonarpost/v1/vessel-3/acoustic/rx" not in heard.keys
    assert keys.alive("vessel-3", "relay") not in heard.tokens
    world.shore.wait_for("A peer is on no list, whatever it says is denied", "peer=vessel-3 ")


def test_an_observer_sees_everything_and_changes_nothing(world, ashore, heard):
    got: list[str] = []
    key = keys.shore_image("vessel-2")
    with world.open("observer-1") as watcher:
        watcher.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))

        def put_and_seen() -> bool:
            ashore.put(key, b"seen")
            return key in got

        eventually(put_and_seen, what="the picture")
        watcher.put(keys.advice("vessel-1"), b"false")
        assert answers(watcher, keys.delivery_query(INBOX_1, "c2")) == []
    world.shore.wait_for("Message denied", "peer=observer-1", "message=Put", f"key={keys.advice('vessel-1')}")


def test_a_vehicle_on_deck_shows_what_it_has_and_no_more(world, heard):
    with world.open("uuv-1") as vehicle:
        own_key_arrives(vehicle, heard, "uuv-1", "before")
        vehicle.put("sonarpost/v1/vessel-1/image/reconstructed", b"false")
        own_key_arrives(vehicle, heard, "uuv-1", "deck")
        assert answers(vehicle, keys.delivery_query(INBOX_1, "c2")) == []
    assert "sonarpost/v1/vessel-1/image/reconstructed" not in heard.keys


def test_a_payload_beyond_eight_mebibytes_stays_outside(world, heard):
    key = "sonarpost/v1/vessel-1/test/large"
    with world.open("vessel-1") as rogue:
        own_key_arrives(rogue, heard, "vessel-1", "before")
        publisher = rogue.declare_publisher(key)
        publisher.put(os.urandom(1 << 20) * 8 + b"x")
        own_key_arrives(rogue, heard, "vessel-1", "after")
        assert key not in heard.keys
        # Right up to the limit a payload passes: it is the size that counts.
        publisher.put(os.urandom(1 << 20) * 8)
        eventually(lambda: key in heard.keys, what="the payload of 8 MiB")
    world.shore.wait_for("Message denied", "too large")


def test_the_router_tells_in_its_health_what_it_refused(world, ashore):
    got: list[Health] = []

    def keep(sample: zenoh.Sample) -> None:
        got.append(wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr)))

    ashore.declare_subscriber(keys.health("shore-1", "router"), keep)
    with world.open("vessel-1") as rogue:
        rogue.put("sonarpost/v1/vessel-2/false", b"")
        eventually(lambda: any(h.counters.get("messages_denied", 0) > 0 for h in got), what="a count of denials")
    assert got[-1].platform_id == "shore-1"
    assert got[-1].gauges["certificate_days_left"] > 300
    assert got[-1].gauges["links"] >= 1
    assert got[-1].state == "ok"
    assert "vessel-1" in got[-1].detail
    tokens = [str(r.ok.key_expr) for r in ashore.liveliness().get(keys.alive("shore-1", "router")) if r.ok]
    assert tokens == [keys.alive("shore-1", "router")]


def test_a_link_ends_with_its_certificate(world):
    folder = world.fleet.issue("vessel-5", "vessel", days=3 / 86400).folder
    with zenoh.open(client_config([world.shore_tls], tls_of(folder))) as session:
        world.shore.wait_for("Peer connected", "peer=vessel-5")
        world.shore.wait_for("Peer gone", "peer=vessel-5")
        assert list(session.info.routers_zid()) == []
