"""Short messages from the relay of a vessel to c2, through an emulated gateway: both ends restarted, budget, radio."""

import json
import struct
from contextlib import closing
from urllib.error import HTTPError
from urllib.parse import urlencode
from urllib.request import urlopen

import msgpack
import pytest
from builders.common import WAIT_S, eventually
from builders.records import decision_record
from extensions.satellite.gateway import MessageGatewayEmulator
from extensions.satellite.records import decision, with_crc
from extensions.satellite.records import received as received_image
from pydantic import ValidationError

from sonarpost import keys
from sonarpost.archive.image_files import PREVIEW_NOTE, image_file_name
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.delivery.store import Store
from sonarpost.errors import ConfigError, DatabaseUnavailableError, DeliveryError
from sonarpost.extensions.satellite.config import ShortMessageOptions
from sonarpost.extensions.satellite.rockblock import RockBlockAccount
from sonarpost.extensions.satellite.short_message import ShortMessage, decision_fragments, pack_decision
from sonarpost.messages import CodedImage
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.services.relay.config import RelayConfig, UpstreamOptions
from sonarpost.services.relay.service import RelayService

IMEI = "300234010753370"
TOKEN = "0123456789abcdef"
CODED, DECISIONS = keys.image_coded("vessel-1"), keys.contact_decision("vessel-1")


def received(number):
    """Return the record of the decompressor."""
    image = received_image(number)
    return CodedImage(**{**image.model_dump(), "contact": image.contact, "codec": "emb", "model": ""})


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr("sonarpost.extensions.satellite.receiver.ACKNOWLEDGE_AFTER_S", 0.1)
    monkeypatch.setattr("sonarpost.extensions.satellite.sender.FIRST_TIMEOUT_S", 0.5)
    monkeypatch.setattr("sonarpost.extensions.satellite.upstream.POLL_S", 0.05)
    monkeypatch.setattr("sonarpost.extensions.satellite.upstream.RETRY_S", 0.1)
    monkeypatch.setattr("sonarpost.extensions.satellite.input.CHECK_S", 0.05)
    monkeypatch.setattr("sonarpost.extensions.satellite.input.RETRY_S", 0.1)


@pytest.fixture
def gateway():
    emulator = MessageGatewayEmulator("http://127.0.0.1:1/", [IMEI], loss=0.2, max_delay_s=0.1, seed=3)
    with closing(emulator):
        yield emulator


@pytest.fixture
def begin_c2(runner, platform, tmp_path, gateway):
    (tmp_path / "token").write_text(TOKEN + "\n")
    (tmp_path / "password").write_text("password\n")

    def begin(vessels=None):
        messages = ShortMessageOptions(
            vessels=vessels or {IMEI: "vessel-1"},
            token_file=tmp_path / "token",
            port=0,
            gateway=gateway.mt_url,
            username="user",
            password_file=tmp_path / "password",
        )
        config = C2Config(out_dir=tmp_path / "out", short_messages=messages)
        service = runner.start(C2Service(platform("shore-1"), config))
        gateway.webhook_url = f"http://127.0.0.1:{input_of(service).port}/{TOKEN}"
        return service

    return begin


@pytest.fixture
def begin_relay(runner, platform, gateway):
    def begin(*upstreams, **options):
        usual = {"bearer": "satellite", "terminal": gateway.terminal_url(IMEI), "check_interval_s": 1.0}
        satellite = UpstreamOptions(**(usual | options))
        return runner.start(RelayService(platform("vessel-1"), RelayConfig(upstreams=(*upstreams, satellite))))

    return begin


@pytest.fixture
def source(runner):
    return runner.peer("vessel-1", "decompressor")


def input_of(service):
    return service._inputs["short-messages"]


def side_cars(tmp_path):
    found = [json.loads(path.read_text()) for path in (tmp_path / "out" / "vessel-1").glob("*.json")]
    return {record["image_id"]: record for record in found if record.get("type") == "reconstructed_image"}


def waits(service):
    gauges = service.gauges()
    return gauges["satellite_waiting_for_shore"] + gauges["satellite_unacknowledged_shore"]


def test_all_records_arrive_once_over_losses_and_restarts_of_both_ends(
    runner, source, begin_c2, begin_relay, tmp_path, gateway, texture
):
    stream = default_registry().create("emb", CodecResources()).encode(texture(80, 140))[:150]
    # The contact record and 150 bytes of a stream are one message each.
    fields = {"stream": stream, "bytes_received": len(stream), "bytes_total": len(stream)}
    images = [received(n).model_copy(update=fields) for n in range(1, 7)]
    images.append(received(7))  # its preview cannot be decoded: the contact arrives without it
    decisions = [decision(f"d{n}", remark="long " * 120 if n == 1 else "") for n in range(3)]
    c2, relay = begin_c2(), begin_relay()
    source.send(CODED, "relay", *images)
    source.send(DECISIONS, "relay", *decisions[:2])
    eventually(lambda: gateway.messages >= 5)
    runner.stop(relay)
    runner.stop(c2)
    c2, relay = begin_c2(), begin_relay()
    source.send(DECISIONS, "relay", decisions[2])
    eventually(lambda: len(side_cars(tmp_path)) == 7 and not waits(relay))
    found = side_cars(tmp_path)
    assert sorted(found) == [image.image_id for image in images]
    assert found["0001"]["contact"] == images[0].contact.model_dump()
    assert (found["0001"]["notes"][0], found["0001"]["missing_fraction"] < 1) == (PREVIEW_NOTE, True)
    assert gateway.lost > 0
    assert relay.gauges()["satellite_bytes_shore"] == gateway.sent_bytes
    assert relay.gauges()["satellite_messages_shore"] == gateway.messages
    index = c2._archive.index()
    eventually(lambda: len(index.decisions()) == 3)
    assert len(index.images()) == 7
    assert c2.gauges()["records_conflicting"] == 0


def test_the_radio_goes_first_and_its_image_replaces_the_preview(
    runner, source, begin_c2, begin_relay, tmp_path, gateway, texture
):
    stream = default_registry().create("emb", CodecResources()).encode(texture(80, 140))
    fields = {"stream": stream, "bytes_received": len(stream), "bytes_total": len(stream)}
    first, second = (received(n).model_copy(update=fields) for n in (1, 2))
    c2 = begin_c2()
    relay = begin_relay(UpstreamOptions(), after_s=3600.0)
    source.send(CODED, "relay", first)
    source.send(DECISIONS, "relay", decision_record())
    relayed = ("coded_images_relayed", "decisions_relayed")
    eventually(lambda: all(relay.health().counters.get(name) == 1 for name in relayed))
    eventually(
        lambda: not relay.store.state_names("short/shore/item/"), what="withdrawal of what the radio has delivered"
    )
    eventually(lambda: relay.store.outbox_depth() == 0, what="delivery by radio")
    eventually(lambda: len(side_cars(tmp_path)) == 1, what="the image at the shore")
    assert gateway.messages == 0
    # The preview of a stored image changes nothing; a preview that came first is replaced.
    runner.stop(relay)
    relay = begin_relay()
    source.send(CODED, "relay", first, second)
    eventually(lambda: len(side_cars(tmp_path)) == 2 and not waits(relay))
    assert side_cars(tmp_path)["0001"]["notes"] == []
    assert side_cars(tmp_path)["0002"]["notes"][0] == PREVIEW_NOTE
    runner.stop(relay)
    begin_relay(UpstreamOptions(), after_s=3600.0)
    source.send(CODED, "relay", second)
    eventually(lambda: side_cars(tmp_path)["0002"]["notes"] == [])
    assert len(list((tmp_path / "out" / "vessel-1").glob(f"{image_file_name(second)}*"))) == 3
    eventually(lambda: len(c2._archive.index().images()) == 2)
    assert c2.gauges()["records_conflicting"] == 0


def test_budget_of_the_day_is_kept_over_a_restart_and_shown(runner, source, begin_relay, gateway):
    relay = begin_relay(bytes_per_day=1000, cost_per_kb=2.0)
    source.send(CODED, "relay", *(received(n) for n in range(1, 7)))
    eventually(lambda: gateway.messages == 3)
    eventually(lambda: "1000 bytes of the day are used; 3 items wait" in relay.warning())
    runner.stop(relay)
    relay = begin_relay(bytes_per_day=1000, cost_per_kb=2.0)
    eventually(lambda: "3 items wait" in relay.warning())
    gauges = relay.gauges()
    assert gateway.messages == 3
    assert gauges["satellite_bytes_today_shore"] == gateway.sent_bytes <= 1000
    assert gauges["satellite_cost_shore"] == pytest.approx(gateway.sent_bytes / 1000 * 2.0)


def test_terminal_that_is_absent_is_reported_and_costs_nothing(source, begin_relay):
    relay = begin_relay(terminal="socket://127.0.0.1:1")
    source.send(CODED, "relay", received(1))
    eventually(lambda: "by satellite: socket://127.0.0.1:1" in relay.warning())
    assert relay.gauges()["satellite_bytes_shore"] == 0
    assert relay.gauges()["satellite_unacknowledged_shore"] == 1


def test_c2_refuses_unknown_terminals_and_invalid_messages(begin_c2, gateway):
    c2 = begin_c2({"300234010753371": "vessel-2"})
    gateway.from_terminal(IMEI, b"x")
    eventually(lambda: c2.health().counters.get("short_messages_refused", 0) >= 1)
    assert c2.health().counters.get("short_messages_received", 0) == 0
    assert c2.store.inbox_depth() == 0


def deliver(gateway, imei, data):
    """Deliver a message to the webhook; return the status."""
    body = urlencode({"imei": imei, "momsn": "1", "data": data.hex()}).encode()
    try:
        with urlopen(gateway.webhook_url, body, timeout=WAIT_S) as reply:
            return reply.status
    except HTTPError as error:
        error.close()
        return error.code


def message(seq, *records):
    items = tuple(item for n, record in enumerate(records) for item in decision_fragments(pack_decision(record), n))
    return ShortMessage(5, seq, seq, items).pack()


def test_state_and_errors_of_one_vessel_do_not_delay_the_others(runner, begin_c2, gateway, monkeypatch):
    vessels = {IMEI: "vessel-1", "300234010753371": "vessel-2", "300234010753372": "vessel-3"}
    c2 = begin_c2(vessels)
    with c2.store.transaction() as tx:
        tx.put_state("short/vessel-2/windows", msgpack.packb([(5, 0, 2**32, {}, 16, 0.0)]))
        tx.put_state("short/vessel-2/1/1/2/7", b"index above count")
    runner.stop(c2)
    c2 = begin_c2(vessels)
    monkeypatch.setattr(gateway, "_loss", 0.0)
    send = RockBlockAccount.send

    def send_or_fail(account, imei, data):
        if imei == "300234010753372":
            raise RuntimeError("a defect")
        if imei != IMEI:
            raise DeliveryError("no such terminal")
        send(account, imei, data)

    monkeypatch.setattr(RockBlockAccount, "send", send_or_fail)
    last_number = with_crc(struct.pack(">BIIB", 0xB1, 5, 2**32 - 1, 0))
    assert deliver(gateway, "300234010753371", last_number) == 400
    for imei in reversed(vessels):
        assert deliver(gateway, imei, message(0, decision("d1"))) == 200
    eventually(lambda: gateway.mailbox(IMEI)[0] is not None)
    eventually(lambda: {"vessel-2", "vessel-3"} <= set(input_of(c2)._faults))
    health = c2.health()
    assert health.state == "degraded"
    assert health.counters["states_discarded"] == 2
    assert not c2.stopping.is_set()
    eventually(lambda: len(c2._archive.index().decisions()) == 3)


def test_records_are_committed_to_a_shared_archive_before_the_message_is_accepted(begin_c2, gateway, monkeypatch):
    c2 = begin_c2()
    accepted = []

    def accept(records):
        accepted.extend(records)
        if len(accepted) == 1:
            raise DatabaseUnavailableError("database: away")

    monkeypatch.setattr(c2._archive, "is_shared", True)
    monkeypatch.setattr(c2._archive, "accept", accept)
    assert deliver(gateway, IMEI, message(0, decision("d1"))) == 503
    assert (c2.store.inbox_depth(), c2.store.state_names("short/")) == (0, ())
    assert deliver(gateway, IMEI, message(0, decision("d1"))) == 200
    assert [key for key, _ in accepted] == [keys.shore_inbox("vessel-1")] * 2
    eventually(lambda: len(c2._archive.index().decisions()) == 1)


def test_unreadable_state_of_the_relay_costs_itself_only(runner, source, begin_c2, begin_relay, gateway, tmp_path):
    relay = begin_relay(terminal="socket://127.0.0.1:1")
    source.send(CODED, "relay", *(received(n) for n in range(1, 4)))
    source.send(DECISIONS, "relay", decision("d1"))
    eventually(lambda: relay.health().counters.get("coded_images_relayed") == 3)
    eventually(lambda: relay.health().counters.get("decisions_relayed") == 1)
    eventually(lambda: relay.gauges()["satellite_unacknowledged_shore"] >= 1)
    runner.stop(relay)
    with closing(Store(relay.store.path)) as store, store.transaction() as tx:
        for name in ("head", "number", "budget", "item/x", "message/x"):
            tx.put_state(f"short/shore/{name}", msgpack.packb(["junk", -1, None]) + bytes(8))
    c2, relay = begin_c2(), begin_relay()
    assert relay.health().counters["states_discarded"] == 5
    eventually(lambda: len(side_cars(tmp_path)) == 3 and not waits(relay))
    eventually(lambda: len(c2._archive.index().decisions()) == 1)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"bearer": "satellite"}, "a terminal"),
        ({"terminal": "/dev/ttyUSB0"}, "no terminal with bearer radio"),
        ({"bearer": "satellite", "terminal": "x", "max_bytes": 1}, "no max_bytes with bearer satellite"),
        ({"bearer": "satellite", "terminal": "x", "windows": ("6-7",)}, "HH:MM"),
        ({"bearer": "satellite", "terminal": "x", "bytes_per_day": 339}, "340"),
    ],
)
def test_invalid_upstreams_are_refused(options, problem):
    with pytest.raises(ValidationError, match=problem):
        UpstreamOptions(**options)


def test_site_has_one_upstream_of_each_kind():
    satellite = UpstreamOptions(bearer="satellite", terminal="x")
    config = RelayConfig(upstreams=(UpstreamOptions(), satellite))
    assert (config.sites(), config.added()) == ((UpstreamOptions(),), (satellite,))
    assert RelayConfig(upstreams=(satellite,)).sites() == ()
    with pytest.raises(ValidationError, match="each site once by satellite"):
        RelayConfig(upstreams=(satellite, satellite))


@pytest.mark.parametrize("text", ["short", "0123456789abcdef/"])
def test_token_has_to_be_long_and_plain(begin_c2, tmp_path, text):
    (tmp_path / "token").write_text(text)
    with pytest.raises(ConfigError, match="token"):
        begin_c2()
