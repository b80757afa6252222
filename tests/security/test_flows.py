"""What a vessel and its shore need of each other passes their routers, and what is in the way is named."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from builders.common import eventually, free_port

from sonarpost import keys, wire
from sonarpost.bus.connectivity import ConnectivityState, diagnose_no_reply, probe_endpoint, query_presence
from sonarpost.bus.session import open_with_retry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Advice, Command, Decision, Record
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.security.router_config import Wanted
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.services.relay.config import RelayConfig, UpstreamOptions
from sonarpost.services.relay.service import RelayService


class Producer(Service[ServiceConfig]):
    """Owes records to somebody."""

    NAME = "producer"

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        raise AssertionError("it consumes nothing")

    def owe(self, key: str, consumer: str, record: Record) -> None:
        effects = UnitOfWork()
        effects.send(key, consumer, record)
        self.commit(effects)


class Console(Service[ServiceConfig]):
    """Takes advice and commands aboard."""

    NAME = "console"

    def __init__(self, platform: PlatformConfig, config: ServiceConfig) -> None:
        super().__init__(platform, config)
        self.got: list[Record] = []

    def consumed_keys(self):
        return {keys.advice(self.platform.id): Advice, keys.command_all(self.platform.id): Command}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        self.got.append(record)


@pytest.fixture
def crew(world, tmp_path):
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


def decision(number: int) -> Decision:
    return Decision(
        decision_id=f"d-{number}",
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id="AAAA",
        image_version=1,
        verdict="unsure",
        operator="op",
        decided_utc_s=1.0,
    )


def test_records_go_up_and_advice_and_commands_come_down(world, crew, tmp_path):
    got: list[str] = []
    c2 = crew(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    relay = crew(
        RelayService,
        "vessel-1",
        world.vessel_local,
        RelayConfig(advice_consumers=("console",), command_consumers=("console",)),
        upstream=(world.shore_tls,),
        tls=world.tls("vessel-1"),
    )
    console = crew(Console, "vessel-1", world.vessel_local)
    operator = crew(Producer, "vessel-1", world.vessel_local)
    expert = crew(Producer, "shore-1", world.shore_local)
    c2.session.declare_subscriber("sonarpost/v1/**", lambda sample: got.append(str(sample.key_expr)))

    operator.owe(keys.contact_decision("vessel-1"), "relay", decision(1))
    eventually(lambda: c2.health().counters.get("decisions_stored") == 1, what="the decision ashore")

    advice = Advice(
        advice_id="a-1",
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id="AAAA",
        image_version=1,
        author="expert",
        verdict="unsure",
        advised_utc_s=2.0,
    )
    expert.owe(keys.tasking_advice("vessel-1"), "c2", advice)
    eventually(lambda: advice in console.got, what="the advice aboard")

    # Watchers ashore see the vessel's health and liveliness; the relay sees that the shore is reached.
    eventually(lambda: keys.health("vessel-1", "relay") in got, what="the relay's health ashore")
    alive = keys.alive("vessel-1", "relay")
    eventually(
        lambda: [str(r.ok.key_expr) for r in c2.session.liveliness().get(alive) if r.ok] == [alive], what="its token"
    )
    eventually(lambda: relay.health().gauges.get("reached_shore") == 1.0, what="the self-test")
    assert relay.health().state == "ok"
    assert relay.health().gauges["certificate_days_left"] > 300
    # Nothing that one vessel and its shore need was refused on the way.
    assert not [line for line in world.vessel.lines if "Message denied" in line]


def test_a_relay_with_a_session_of_its_own_reaches_the_shore(world, crew, tmp_path):
    c2 = crew(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    relay = crew(
        RelayService,
        "vessel-1",
        world.vessel_local,
        RelayConfig(upstreams=(UpstreamOptions(router=(world.shore_tls,)),)),
        tls=world.tls("vessel-1"),
    )
    operator = crew(Producer, "vessel-1", world.vessel_local)
    operator.owe(keys.contact_decision("vessel-1"), "relay", decision(2))
    eventually(lambda: c2.health().counters.get("decisions_stored") == 1, what="the decision ashore")
    eventually(lambda: relay.health().gauges.get("reached_shore") == 1.0, what="the self-test")


def test_a_malformed_or_too_large_record_is_refused_by_c2_and_told(world, crew, tmp_path, caplog, aboard):
    c2 = crew(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    key = keys.delivery_query(keys.shore_inbox("vessel-1"), "c2")
    replies: list[bytes] = []

    def refused_again() -> bool:
        found = [r.ok.payload.to_bytes() for r in aboard.get(key, payload=b"x" * 40000, attachment=b"junk") if r.ok]
        replies.extend(found)
        return bool(found)

    eventually(refused_again, what="c2's answer")
    assert wire.unpack_map(replies[0], key)["status"] == "refused"
    assert c2.health().counters["records_refused"] >= 1
    assert "Record refused" in caplog.text


def test_the_self_test_tells_what_is_in_the_way(world, crew, aboard, tmp_path):
    endpoints = (world.shore_tls,)
    tls = world.tls("vessel-1")

    def reached(vessel: str) -> ConnectivityState:
        return diagnose_no_reply(query_presence(aboard, vessel), endpoints, tls).reach

    # The shore's router answers; c2 does not run.
    eventually(lambda: reached("vessel-1") is ConnectivityState.NOBODY_THERE, what="the router's answer")
    crew(C2Service, "shore-1", world.shore_local, C2Config(out_dir=tmp_path / "out"))
    eventually(lambda: reached("vessel-1") is ConnectivityState.REACHED, what="c2's answer")
    # A vessel whose `id` is not the certificate's name: TLS lets it in, the list does not.
    assert reached("vessel-2") is ConnectivityState.DENIED


@pytest.mark.parametrize(
    ("who", "words"),
    [
        ("stranger", "certificate verify failed"),
        ("expired", "certificate expired"),
        ("nobody", "[platform] has no tls"),
    ],
)
def test_a_refused_certificate_is_named_as_such(world, who, words):
    tls = None if who == "nobody" else world.tls(who)
    if who == "stranger":
        tls = tls.model_copy(update={"ca": world.fleet.folder / "ca.pem"})
        words = "unknown ca"
    outcome = probe_endpoint(world.shore_tls, tls)
    assert outcome.reach is ConnectivityState.TLS_REFUSED
    assert words in outcome.detail
    assert outcome.detail.startswith(world.shore_tls)


def test_an_endpoint_where_nobody_listens_is_no_connection():
    endpoint = f"tls/localhost:{free_port()}"
    assert probe_endpoint(endpoint, None).reach is ConnectivityState.NO_CONNECTION
    assert probe_endpoint("tls/no-such-host.invalid:1", None).reach is ConnectivityState.NO_CONNECTION
    assert probe_endpoint("somewhere", None).reach is ConnectivityState.UNKNOWN


def test_a_revoked_vessel_is_told_that_it_is_denied(world, crew, caplog):
    local = f"tcp/127.0.0.1:{free_port()}"
    # The thief's router runs with the configuration of before the revocation.
    before = world.fleet.index()
    entries = tuple(e.model_copy(update={"revoked_utc_s": None}) for e in before.certificates)
    thief = type(world)(
        **{**vars(world), "fleet": _Unrevoked(before.model_copy(update={"certificates": entries[:-1]}))}
    )
    wanted = Wanted("vessel-3", local=[local], connect=[world.shore_tls], files=world.folders["vessel-3"])
    thief.start("vessel-3", wanted)
    relay = crew(RelayService, "vessel-3", local, RelayConfig(), upstream=(world.shore_tls,), tls=world.tls("vessel-3"))
    eventually(lambda: "denied by access control" in relay.health().detail, what="the self-test")
    assert relay.health().state == "degraded"
    assert "Shore not reached" in caplog.text


class _Unrevoked:
    def __init__(self, index) -> None:
        self._index = index

    def index(self):
        return self._index


def test_a_service_that_cannot_connect_for_its_certificate_says_so(world, caplog):
    stop = threading.Event()
    waiting = threading.Thread(target=lambda: open_with_retry([world.shore_tls], stop, world.tls("expired")))
    waiting.start()
    eventually(lambda: "Zenoh router not reached" in caplog.text, what="the warning")
    stop.set()
    waiting.join()
    [record] = [r for r in caplog.records if r.message.startswith("Zenoh router not reached")]
    assert "certificate expired" in vars(record)["fields"]["error"]


def test_no_part_of_a_key_is_in_logs_health_or_the_process_list(world, crew, caplog):
    relay = crew(RelayService, "vessel-1", world.vessel_local, RelayConfig(), tls=world.tls("vessel-1"))
    keys_of_hosts = [path.read_text() for path in world.folder.rglob("key.pem")]
    secrets = [line for text in keys_of_hosts for line in text.splitlines() if not line.startswith("-----")]
    assert len(secrets) > 20
    said = [caplog.text, relay.health().model_dump_json()]
    for router in world.routers.values():
        said += router.lines
        said.append(Path(f"/proc/{router.process.pid}/cmdline").read_text(errors="replace"))
    written = "\n".join(said)
    assert "router" in written
    assert not [secret for secret in secrets if secret in written]
