"""Unauthorised peers neither send nor receive anything, and the router logs them."""

import os

import pytest
import zenoh
from builders.common import eventually, free_port
from builders.fleet_certificates import tls_of

from sonarpost import keys, wire
from sonarpost.bus.connectivity import ConnectivityState, probe_endpoint
from sonarpost.bus.session import client_config
from sonarpost.messages import Health
from sonarpost.security.router_config import RouterOptions

pytestmark = pytest.mark.system

INBOX_1 = keys.shore_inbox("vessel-1")
INBOX_2 = keys.shore_inbox("vessel-2")


class Received:
    """Publications, delivery queries and liveliness tokens that reach a session at the shore."""

    def __init__(self, session):
        self.keys: list[str] = []
        self.queries: list[str] = []
        self.tokens: list[str] = []
        session.declare_subscriber("sonarpost/**", lambda sample: self.keys.append(str(sample.key_expr)))
        session.declare_queryable(keys.delivery_query(keys.shore_inbox_all(), "c2"), self._answer)
        session.liveliness().declare_subscriber(
            "sonarpost/**", lambda sample: self.tokens.append(str(sample.key_expr)), history=True
        )

    def _answer(self, query):
        with query:
            self.queries.append(str(query.key_expr))
            query.reply(query.key_expr, b"answer")


@pytest.fixture
def received(shore_session):
    return Received(shore_session)


def answers(session, key):
    return [reply.ok.payload.to_bytes() for reply in session.get(key, timeout=30) if reply.ok is not None]


def own_key_arrives(session, received, vessel, note):
    """Wait for a message on the session's own key: earlier messages have then arrived, as a link keeps their order."""
    key = f"{keys.everything_of(vessel)[:-2]}test/{note}"

    def put_and_received():
        # Repeatedly: a message before the subscription is known is dropped.
        session.put(key, b"")
        return key in received.keys

    eventually(put_and_received, what=key)


@pytest.mark.parametrize(
    ("who", "reason"),
    [("", "peer sent no certificates"), ("stranger", "UnknownIssuer"), ("expired", "certificate expired")],
)
def test_connection_without_a_valid_certificate_is_refused(world, who, reason):
    config = client_config([world.shore_tls], world.tls(who or "vessel-2"))
    if who == "stranger":
        config.insert_json5("transport/link/tls/root_ca_certificate", f'"{world.fleet.folder / "ca.pem"}"')
    if not who:
        config.insert_json5("transport/link/tls/enable_mtls", "false")
        for name in ("connect_private_key", "connect_certificate"):
            config.insert_json5(f"transport/link/tls/{name}", "null")
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)
    world.shore.wait_for("zenoh_link_tls", reason)


def test_server_with_another_host_name_is_refused(world):
    endpoint = f"tls/localhost:{free_port()}"
    wanted = RouterOptions("shore-2", listen=[endpoint], local=[], files=world.folders["nameless"])
    router = world.start("shore-2", wanted)
    outcome = probe_endpoint(endpoint, world.tls("vessel-2"))
    assert outcome.state is ConnectivityState.TLS_REFUSED
    assert "localhost" in outcome.detail
    with pytest.raises(zenoh.ZError):
        world.open("vessel-2", endpoint=endpoint)
    router.wait_for("zenoh_link_tls", "fatal alert")
    router.stop()


@pytest.mark.parametrize("who", ["vessel-1", "uuv-1"])
def test_vessel_and_vehicle_on_deck_write_below_their_own_prefix_only(world, received, who):
    foreign = ["sonarpost/v1/vessel-2/acoustic/rx", "sonarpost/v1/shore/contact/vessel-2/image", INBOX_2, "other/key"]
    foreign.append("sonarpost/v1/vessel-3/image/reconstructed")
    with world.open(who) as rogue:
        own_key_arrives(rogue, received, who, "before-writes")
        for key in foreign:
            rogue.put(key, b"false")
        rogue.delete("sonarpost/v1/vessel-2/acoustic/rx")
        own_key_arrives(rogue, received, who, "writes")
        if who == "uuv-1":
            assert answers(rogue, keys.delivery_query(INBOX_1, "c2")) == []
    assert not set(foreign) & set(received.keys)
    for key in foreign:
        world.shore.wait_for_denial(who, "Put", key)
    world.shore.wait_for_denial(who, "Delete", "")


def test_peers_and_routers_have_the_same_rights(world, received):
    for mode in ("peer", "router"):
        key = f"sonarpost/v1/vessel-2/as-{mode}"
        with world.open("vessel-1", mode) as rogue:
            # A peer or router sends to known subscribers only.
            own_key_arrives(rogue, received, "vessel-1", f"before-{mode}")
            rogue.put(key, b"false")
            own_key_arrives(rogue, received, "vessel-1", f"as-{mode}")
        assert key not in received.keys
        world.shore.wait_for_denial("vessel-1", "Put", key)


def test_vessel_delivers_to_its_own_inbox_only(world, received):
    with world.open("vessel-1") as rogue:
        eventually(
            lambda: answers(rogue, keys.delivery_query(INBOX_1, "c2")) == [b"answer"], what="delivery to the own inbox"
        )
        assert answers(rogue, keys.delivery_query(INBOX_2, "c2")) == []
        assert answers(rogue, keys.delivery_query(keys.shore_inbox_all(), "c2")) == []
        assert answers(rogue, "sonarpost/**") == []
    assert {key for key in received.queries if "vessel-1" not in key} == set()
    world.shore.wait_for_denial("vessel-1", "Query", keys.delivery_query(INBOX_2, "c2"))


def test_vessel_replies_on_its_own_keys_only(world, shore_session, received):
    with world.open("vessel-1") as rogue:
        for vessel in ("vessel-1", "vessel-2"):
            rogue.declare_queryable(
                keys.delivery_query(keys.comment(vessel), "relay"), lambda query: query.reply(query.key_expr, b"mine")
            )
        own = keys.delivery_query(keys.comment("vessel-1"), "relay")
        eventually(lambda: answers(shore_session, own) == [b"mine"], what="the reply on its own key")
        assert answers(shore_session, keys.delivery_query(keys.comment("vessel-2"), "relay")) == []
    world.shore.wait_for_denial("vessel-1", "Queryable", "vessel-2/comment/delivery/relay")


def test_vessel_receives_its_own_prefix_only(world, shore_session):
    got: list[str] = []
    with world.open("vessel-1") as rogue:
        for key in (
            "sonarpost/v1/vessel-2/**",
            "sonarpost/v1/shore/**",
            "sonarpost/**",
            "**",
            keys.comment("vessel-1"),
        ):
            rogue.declare_subscriber(key, lambda sample: got.append(str(sample.key_expr)))

        def put_and_got():
            shore_session.put("sonarpost/v1/vessel-2/acoustic/rx", b"secret")
            shore_session.put(keys.shore_image("vessel-2"), b"secret")
            shore_session.put(keys.comment("vessel-1"), b"own")
            return keys.comment("vessel-1") in got

        eventually(put_and_got, what="its own key")
    assert set(got) == {keys.comment("vessel-1")}
    world.shore.wait_for_denial("vessel-1", "Subscriber", "sonarpost/v1/vessel-2/**")


def test_vessel_neither_sets_nor_sees_liveliness_of_another(world, shore_session, received):
    false, true = keys.alive("vessel-2", "relay-false"), keys.alive("vessel-1", "relay-true")
    token = shore_session.liveliness().declare_token(keys.alive("vessel-2", "relay"))
    with world.open("vessel-1") as rogue:
        tokens = [rogue.liveliness().declare_token(key) for key in (false, true)]
        eventually(lambda: true in received.tokens, what="its own token")
        assert false not in received.tokens
        # A session sees its own tokens, but not those of another vessel.
        seen = {str(reply.ok.key_expr) for reply in rogue.liveliness().get("sonarpost/v1/*/alive/*") if reply.ok}
        assert seen <= {false, true}
        del tokens
    token.undeclare()
    world.shore.wait_for_denial("vessel-1", "Liveliness Token", false)


def test_revoked_certificate_is_denied_and_the_new_one_works(world, received):
    with world.open("vessel-3") as rogue, world.open("vessel-3.g2") as honest:
        own_key_arrives(honest, received, "vessel-3", "before")
        rogue.put("sonarpost/v1/vessel-3/acoustic/rx", b"stolen")
        assert answers(rogue, keys.delivery_query(keys.shore_inbox("vessel-3"), "c2")) == []
        rogue.liveliness().declare_token(keys.alive("vessel-3", "relay"))
        publisher = rogue.declare_publisher("sonarpost/v1/vessel-3/acoustic/rx")
        own_key_arrives(honest, received, "vessel-3", "honest")
        assert answers(honest, keys.delivery_query(keys.shore_inbox("vessel-3"), "c2")) == [b"answer"]
        assert not publisher.matching_status.matching
    assert "sonarpost/v1/vessel-3/acoustic/rx" not in received.keys
    assert keys.alive("vessel-3", "relay") not in received.tokens
    world.shore.wait_for("Peer denied by access control", "peer=vessel-3 ")


def test_observer_reads_everything_and_writes_nothing(world, shore_session, received):
    got: list[str] = []
    key = keys.shore_image("vessel-2")
    with world.open("observer-1") as watcher:
        watcher.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))

        def put_and_seen():
            shore_session.put(key, b"seen")
            return key in got

        eventually(put_and_seen, what="the image")
        watcher.put(keys.comment("vessel-1"), b"false")
        assert answers(watcher, keys.delivery_query(INBOX_1, "c2")) == []
    world.shore.wait_for_denial("observer-1", "Put", keys.comment("vessel-1"))


def test_payload_above_8_mib_is_refused(world, received):
    key = "sonarpost/v1/vessel-1/test/large"
    with world.open("vessel-1") as rogue:
        own_key_arrives(rogue, received, "vessel-1", "before")
        publisher = rogue.declare_publisher(key)
        publisher.put(os.urandom(1 << 20) * 8 + b"x")
        own_key_arrives(rogue, received, "vessel-1", "after")
        assert key not in received.keys
        # A payload of exactly the limit passes.
        publisher.put(os.urandom(1 << 20) * 8)
        eventually(lambda: key in received.keys, what="the payload of 8 MiB")
    world.shore.wait_for_denial("", "", "")


def test_router_health_reports_links_certificate_and_denied_peers(world, shore_session):
    got: list[Health] = []

    def keep(sample):
        got.append(wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr)))

    shore_session.declare_subscriber(keys.health("shore-1", "router"), keep)
    with world.open("vessel-3"):
        eventually(lambda: any("denied by access control: vessel-3" in h.detail for h in got), what="the denied peer")
    assert got[-1].platform_id == "shore-1"
    assert got[-1].gauges["certificate_days_left"] > 300
    assert got[-1].gauges["links"] >= 1
    assert got[-1].state == "ok"
    tokens = [str(r.ok.key_expr) for r in shore_session.liveliness().get(keys.alive("shore-1", "router")) if r.ok]
    assert tokens == [keys.alive("shore-1", "router")]
    eventually(lambda: got[-1].detail == "", what="an end of the denial with the link")


def test_default_log_shows_refused_certificates_plain_tcp_and_denied_peers(world):
    """Without RUST_LOG, as operators run it."""
    port = free_port()
    wanted = RouterOptions("shore-1", listen=[f"tls/localhost:{port}"], local=[], files=world.folders["shore-1"])
    router = world.start("shore-1", wanted, zenoh_log=None)
    stranger = client_config([f"tls/localhost:{port}"], world.tls("stranger"))
    stranger.insert_json5("transport/link/tls/root_ca_certificate", f'"{world.fleet.folder / "ca.pem"}"')
    plain = client_config([f"tcp/localhost:{port}"])
    expired = client_config([f"tls/localhost:{port}"], world.tls("expired"))
    for config, reason in ((stranger, "UnknownIssuer"), (expired, "certificate expired"), (plain, "corrupt message")):
        with pytest.raises(zenoh.ZError):
            zenoh.open(config)
        router.wait_for(" WARN ", "zenoh_link_tls", reason)
    with world.open("vessel-3", endpoint=f"tls/localhost:{port}") as revoked:
        zid = str(revoked.info.zid())
        router.wait_for(f"{zid} did not match any configured ACL subject", "`Deny` will be applied")
        router.wait_for(
            "WARNING", "Peer denied by access control", "peer=vessel-3 ", "address=tls/127.0.0.1:", f"zid={zid}"
        )
    assert not [line for line in router.lines if "\x1b" in line]
    router.stop()


def test_link_closes_when_its_certificate_expires(world):
    folder = world.fleet.issue("vessel-5", "vessel", days=3 / 86400).folder
    with zenoh.open(client_config([world.shore_tls], tls_of(folder))) as session:
        world.shore.wait_for("Peer connected", "peer=vessel-5")
        world.shore.wait_for("Peer disconnected", "peer=vessel-5")
        assert list(session.info.routers_zid()) == []
