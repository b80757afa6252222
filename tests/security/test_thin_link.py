"""`--thin-link`: the shore receives fewer health reports; records and their acknowledgements all pass."""

import json
import time
from collections import Counter
from pathlib import PurePosixPath

import pytest
import zenoh
from builders.common import eventually, free_port
from builders.fleet_certificates import matching

from sonarpost import keys
from sonarpost.bus.session import client_config
from sonarpost.cli.main import main
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.outbox import Outbox
from sonarpost.delivery.store import Store
from sonarpost.security.router_config import THIN_HEALTH_S, RouterOptions

pytestmark = pytest.mark.system

VESSEL = "vessel-2"
THINNED = tuple(keys.health(VESSEL, service) for service in ("relay", "op_modem"))
OTHER = keys.health(VESSEL, "own_program")
REPORTS = 20


@pytest.fixture(scope="module")
def endpoints(shared_world):
    """Local endpoints of a second vessel's router and a shore's router with a thin link."""
    tls = f"tls/localhost:{free_port()}"
    shore, vessel = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    files = {name: PurePosixPath(shared_world.folders[name]) for name in ("shore-1", VESSEL)}
    at_shore = RouterOptions("shore-1", listen=[tls], local=[shore], files=files["shore-1"], thin_link=True)
    at_vessel = RouterOptions(VESSEL, local=[vessel], connect=[tls], files=files[VESSEL], thin_link=True)
    routers = [shared_world.start("thin-shore", at_shore), shared_world.start("thin", at_vessel)]
    yield vessel, shore
    for router in routers:
        router.stop()


@pytest.fixture
def vessel(endpoints):
    with zenoh.open(client_config([endpoints[0]])) as session:
        yield session


@pytest.fixture
def shore(endpoints):
    with zenoh.open(client_config([endpoints[1]])) as session:
        yield session


def test_reports_of_each_service_are_thinned_for_the_shore_only(vessel, shore):
    at_shore: Counter[str] = Counter()
    at_vessel: Counter[str] = Counter()
    shore.declare_subscriber(keys.health_all(VESSEL), lambda s: at_shore.update([str(s.key_expr)]))
    publishers = [matching(vessel, key) for key in (*THINNED, OTHER)]
    vessel.declare_subscriber(keys.health_all(VESSEL), lambda s: at_vessel.update([str(s.key_expr)]))
    started_s = time.monotonic()
    for _ in range(REPORTS):
        for publisher in publishers:
            publisher.put(b"report")
    eventually(lambda: at_shore[OTHER] == REPORTS, what="reports that are not thinned")
    periods = (time.monotonic() - started_s) // THIN_HEALTH_S
    assert all(1 <= at_shore[key] <= 1 + periods for key in THINNED)
    eventually(lambda: all(at_vessel[key] == REPORTS for key in THINNED), what="reports on the vessel")
    before = at_shore.copy()

    def put_and_passed():
        for publisher in publishers:
            publisher.put(b"report")
        return all(at_shore[key] > before[key] for key in THINNED)

    eventually(put_and_passed, what="the next reports")


@pytest.mark.parametrize(
    ("key", "consumer", "at_shore"),
    [
        (keys.shore_part(VESSEL), "c2", True),
        (keys.shore_inbox(VESSEL), "c2", True),
        (keys.command(VESSEL, "resend"), "relay", False),
        (keys.comment(VESSEL), "relay", False),
    ],
)
def test_records_and_acknowledgements_are_not_thinned(vessel, shore, tmp_path, key, consumer, at_shore):
    source, sink = (vessel, shore) if at_shore else (shore, vessel)
    sent, stored = Store(tmp_path / "sent.db"), Store(tmp_path / "stored.db")
    inbox = Inbox(sink, stored, consumer, (key,), lambda _key, _payload: None, lambda _error: None)
    for number in range(30):
        with sent.transaction() as tx:
            tx.send(key, consumer, b"record %d" % number, encoding="")
    outbox = Outbox(source, sent)
    eventually(lambda: sent.outbox_depth() == 0, what="all acknowledgements")
    assert [item.payload for item in stored.inbox_items(100)] == [b"record %d" % n for n in range(30)]
    for closing in (outbox, inbox, sent, stored):
        closing.close()


@pytest.mark.parametrize("platform", [VESSEL, "shore-1"])
def test_only_compression_and_published_health_differ(world, platform, capsys):
    made = []
    for options in (["--thin-link"], []):
        command = ["pki", "router-config", "--dir", str(world.fleet.folder), "--platform", platform, *options]
        assert main(command) == 0
        text = capsys.readouterr().out
        made.append(json.loads("\n".join(line for line in text.splitlines() if not line.startswith("//"))))
    thin, default = made
    sections = thin.pop("downsampling")
    assert default.pop("downsampling") == []
    assert [one["transport"].pop("unicast")["compression"]["enabled"] for one in (thin, default)] == [True, False]
    assert thin == default
    if platform == "shore-1":
        assert sections == []
        return
    [section] = sections
    assert (section["flows"], section["messages"], section["link_protocols"]) == (["egress"], ["put"], ["tls"])
    platforms, services = zip(*(keys.service_of(rule["key_expr"]) for rule in section["rules"]), strict=True)
    assert set(platforms) == {VESSEL}
    assert {"router", "op_modem", "decompressor", "relay", "console"} <= set(services)
