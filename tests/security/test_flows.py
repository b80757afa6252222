"""Authorised traffic between a vessel and its shore passes their routers; obstacles are reported."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from builders.common import eventually, free_port
from builders.records import decision_record

from sonarpost import keys, wire
from sonarpost.bus.connectivity import ConnectivityState, diagnose_no_reply, probe_endpoint, query_presence
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Command, Comment, Record
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.security.router_config import RouterOptions
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.services.relay.config import RelayConfig, UpstreamOptions
from sonarpost.services.relay.service import RelayService

pytestmark = pytest.mark.system


class Producer(Service[ServiceConfig]):
    """Sends records."""

    NAME = "producer"

    def handle(self, key, record, effects):
        raise AssertionError("consumes nothing")

    def send(self, key, consumer, record):
        effects = UnitOfWork()
        effects.send(key, consumer, record)
        self.commit(effects)


class Console(Service[ServiceConfig]):
    """Consumes comments and commands on the vessel."""

    NAME = "console"

    def __init__(self, platform, config):
        super().__init__(platform, config)
        self.got: list[Record] = []

    def consumed_keys(self):
        return {keys.comment(self.platform.id): Comment, keys.command_all(self.platform.id): Command}

    def handle(self, key, record, effects):
        self.got.append(record)


@pytest.fixture
def start_service(tmp_path):
    started = []

    def start(service_type, platform_id, router, config=None, **platform):
        made = PlatformConfig(
            id=platform_id, router=(router,), state_dir=tmp_path / platform_id, health_interval_s=0.2, **platform
        )
        service = service_type(made, config or ServiceConfig())
        started.append(service)
        assert service.start()
        return service

    yield start
    for service in reversed(started):
        service.stop()


def test_records_comment_and_commands_pass_the_routers(own_world, start_service, tmp_path):
    world = own_world
    got: list[str] = []
    c2 = start_service(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    relay = start_service(
        RelayService,
        "vessel-1",
        world.vessel_local,
        RelayConfig(comment_consumers=("console",), command_consumers=("console",)),
        upstream=(world.shore_tls,),
        tls=world.tls("vessel-1"),
    )
    console = start_service(Console, "vessel-1", world.vessel_local)
    operator = start_service(Producer, "vessel-1", world.vessel_local)
    expert = start_service(Producer, "shore-1", world.shore_local)
    c2.session.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))

    operator.send(keys.contact_decision("vessel-1"), "relay", decision_record("d-1"))
    eventually(lambda: c2.health().counters.get("decisions_stored") == 1, what="the decision at the shore")

    fields = {"vehicle_id": "uuv-1", "image_id": "AAAA", "image_version": 1, "author": "expert", "commented_utc_s": 2.0}
    comment = Comment(comment_id="a-1", vessel_id="vessel-1", verdict="unsure", **fields)
    expert.send(keys.tasking_comment("vessel-1"), "c2", comment)
    eventually(lambda: comment in console.got, what="the comment at the vessel")

    # Subscribers at the shore see the vessel's health and liveliness; the relay reports the shore as reached.
    eventually(lambda: keys.health("vessel-1", "relay") in got, what="the relay's health at the shore")
    alive = keys.alive("vessel-1", "relay")
    eventually(
        lambda: [str(r.ok.key_expr) for r in c2.session.liveliness().get(alive) if r.ok] == [alive], what="its token"
    )
    eventually(lambda: relay.health().gauges.get("reached_shore") == 1.0, what="the connectivity check")
    assert relay.health().state == "ok"
    assert relay.health().gauges["certificate_days_left"] > 300
    # No message that the vessel and its shore require was denied.
    assert world.vessel.denied() == []


def test_relay_with_its_own_session_reaches_the_shore(world, start_service, tmp_path):
    c2 = start_service(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    relay = start_service(
        RelayService,
        "vessel-1",
        world.vessel_local,
        RelayConfig(upstreams=(UpstreamOptions(router=(world.shore_tls,)),)),
        tls=world.tls("vessel-1"),
    )
    operator = start_service(Producer, "vessel-1", world.vessel_local)
    operator.send(keys.contact_decision("vessel-1"), "relay", decision_record("d-2"))
    eventually(lambda: c2.health().counters.get("decisions_stored") == 1, what="the decision at the shore")
    eventually(lambda: relay.health().gauges.get("reached_shore") == 1.0, what="the connectivity check")


def test_malformed_record_is_refused_by_c2_and_logged(world, start_service, tmp_path, caplog, vessel_session):
    c2 = start_service(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    key = keys.delivery_query(keys.shore_inbox("vessel-1"), "c2")
    replies: list[bytes] = []

    def refused_repeatedly():
        found = [
            r.ok.payload.to_bytes() for r in vessel_session.get(key, payload=b"x" * 40000, attachment=b"junk") if r.ok
        ]
        replies.extend(found)
        return bool(found)

    eventually(refused_repeatedly, what="c2's reply")
    assert wire.unpack_map(replies[0], key)["status"] == "refused"
    assert c2.health().counters["records_refused"] >= 1
    assert "Record refused" in caplog.text


def test_connectivity_check_names_the_obstacle(world, start_service, vessel_session, tmp_path):
    endpoints = (world.shore_tls,)
    tls = world.tls("vessel-1")

    def reached(vessel):
        return diagnose_no_reply(query_presence(vessel_session, vessel), endpoints, tls).state

    # The router of the shore replies; c2 does not run.
    eventually(lambda: reached("vessel-1") is ConnectivityState.NO_C2, what="the router's reply")
    start_service(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    eventually(lambda: reached("vessel-1") is ConnectivityState.REACHED, what="c2's answer")
    # The `id` of the vessel differs from the certificate name: TLS accepts it, access control does not.
    assert reached("vessel-2") is ConnectivityState.DENIED


def test_absent_and_invalid_endpoints_are_no_connection_and_no_reply():
    for absent in (f"tls/localhost:{free_port()}", "tls/no-such-host.invalid:1"):
        assert probe_endpoint(absent, None).state is ConnectivityState.NO_CONNECTION
    assert probe_endpoint("somewhere", None).state is ConnectivityState.NO_REPLY


def test_revoked_vessel_reports_that_it_is_denied(world, start_service, caplog):
    local = f"tcp/127.0.0.1:{free_port()}"
    # The stolen router runs with the configuration from before the revocation.
    now = world.fleet.index()
    names = [entry for entry in now.certificates if entry.common_name != "vessel-3.g2"]
    entries = tuple(entry.model_copy(update={"revoked_utc_s": None}) for entry in names)
    index = now.model_copy(update={"certificates": entries})
    stolen = replace(world, fleet=SimpleNamespace(index=lambda: index))
    wanted = RouterOptions("vessel-3", local=[local], connect=[world.shore_tls], files=world.folders["vessel-3"])
    router = stolen.start("vessel-3", wanted)
    relay = start_service(
        RelayService, "vessel-3", local, RelayConfig(), upstream=(world.shore_tls,), tls=world.tls("vessel-3")
    )
    eventually(lambda: "denied by access control" in relay.health().detail, what="the connectivity check")
    assert relay.health().state == "degraded"
    assert "Shore not reached" in caplog.text
    router.stop()


def test_no_part_of_a_key_appears_in_logs_health_or_process_list(world, start_service, caplog):
    relay = start_service(RelayService, "vessel-1", world.vessel_local, RelayConfig(), tls=world.tls("vessel-1"))
    keys_of_hosts = [path.read_text() for path in world.folder.rglob("key.pem")]
    secrets = [line for text in keys_of_hosts for line in text.splitlines() if not line.startswith("-----")]
    assert len(secrets) > 20
    texts = [caplog.text, relay.health().model_dump_json()]
    for router in (router for router in world.routers.values() if router.process.poll() is None):
        texts += router.lines
        texts.append(Path(f"/proc/{router.process.pid}/cmdline").read_text(errors="replace"))
    written = "\n".join(texts)
    assert "router" in written
    assert not [secret for secret in secrets if secret in written]
