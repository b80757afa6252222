"""The console service with its neighbours: received records, sent records, health."""

import sqlite3
import threading
import time
from types import SimpleNamespace

import httpx2
import msgpack
import pytest
import zenoh
from builders.common import eventually, free_port, publish_once
from builders.console import (
    PASSWORD,
    VESSEL,
    Browser,
    EventReader,
    comment_record,
    contact_id,
    downlink_state,
    image_record,
    queue_state,
    received_frame,
    session_cookie,
)
from builders.record_samples import SAMPLES
from builders.records import decision_record
from builders.shore import Site, relayed

from sonarpost import keys, wire
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.bus.session import client_config, router_config
from sonarpost.errors import ConfigError, DeliveryError, PortError
from sonarpost.messages import (
    Command,
    Comment,
    Decision,
    LinkQuality,
    Pixels,
    ReceivedStatus,
    Relayed,
    TaskingState,
)
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.service import ConsoleService
from sonarpost.services.console.store import contacts
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

ID = contact_id()


def image(version=1, *, complete=True):
    return image_record("00A7", version, missing_rows=0 if complete else 20)


@pytest.fixture
def log_in():
    """Logs in to a running console service as a new user."""
    clients = []

    def make(console, user, role):
        console._users.add(user, role, PASSWORD)
        clients.append(httpx2.Client(base_url=console.address, timeout=120))
        browser = Browser(clients[-1])
        assert browser.login(user).status_code == 200
        return browser

    yield make
    for client in clients:
        client.close()


@pytest.fixture
def start(runner, platform):
    def make(**options):
        role = options.get("role", "vessel")
        config = ConsoleConfig(**{"port": 0, "take_back_s": 0, **options})
        return runner.start(ConsoleService(platform(VESSEL if role == "vessel" else "shore-1"), config))

    return make


def put(client, key, record):
    publish_once(client, key, wire.encode(record), wire.encoding_of(type(record)))


@pytest.fixture
def start_with_image(start, client, log_in):
    """A console that has received an image, and its operator."""

    def make(received=image, **options):
        console = start(**options)
        put(client, keys.image_reconstructed(VESSEL), received())
        anna = log_in(console, "anna", "operator")
        eventually(lambda: anna.get("/api/contacts").json()["total"] == 1, what="image")
        return console, anna

    return make


def test_images_are_published_and_a_decision_is_sent_to_relay_and_modem(runner, start, client, log_in):
    relay = runner.peer(VESSEL, "relay", {keys.contact_decision(VESSEL): Decision})
    modem = runner.peer(
        VESSEL, "op_modem", {keys.contact_decision(VESSEL): Decision, keys.command_all(VESSEL): Command}
    )
    decompressor = runner.peer(VESSEL, "decompressor")
    console = start()
    anna = log_in(console, "anna", "operator")
    stream = EventReader(console.address, anna.client.cookies[session_cookie(console.address)])
    eventually(lambda: stream.names() == ["hello"], what="stream")
    key = keys.image_reconstructed(VESSEL)
    decompressor.send(key, "console", image(1, complete=False))

    def is_published(field):
        contacts = [data for name, _, data in stream.events if name == "contact"]
        return any(data["contact"][field] if field == "complete" else data[field] for data in contacts)

    eventually(lambda: is_published("new"), what="contact")
    decompressor.send(key, "console", image(2))
    eventually(lambda: is_published("complete"), what="complete image")
    decision = anna.decide(ID).json()["decision"]
    eventually(lambda: len(relay.received) == len(modem.received) == 1, what="decision")
    assert relay.received == modem.received
    sent = relay.received[0]
    assert (sent.decision_id, sent.operator, sent.image_version) == (decision["decision_id"], "anna", 2)

    def delivery():
        return anna.contact(ID)["contact"]["delivery"]

    eventually(lambda: (delivery()["shore"], delivery()["vehicle"]) == ("relay", "asked"), what="acknowledgements")
    now = time.time() + 1
    confirmed = downlink_state("decision", decision["decision_id"], "confirmed", now, times_sent=2)
    put(client, keys.acoustic_downlink(VESSEL), confirmed)
    eventually(lambda: delivery()["vehicle"] == "confirmed", what="confirmation")
    stream.close()


def test_invalid_subscribed_and_stored_records_affect_no_other(start, client, monkeypatch):
    console = start()

    def fail(_state):
        raise ValueError("a defect")

    monkeypatch.setattr(console.state, "apply_tasking_state", fail)
    monkeypatch.setattr(console.state, "fleet_state", dict)
    console._subscribe(keys.tasking_state(VESSEL), TaskingState, fail)
    state = TaskingState(vessel_id=VESSEL, kind="command", record_id="c-1", state="delivered", changed_utc_s=1.0)
    put(client, keys.tasking_state(VESSEL), state)
    put(client, keys.acoustic_queue("uuv-8"), queue_state([], 1.0))
    put(client, keys.acoustic_queue("uuv-1"), queue_state([], 1.0))
    eventually(lambda: "uuv-1" in console.state.fleet.vehicles(), what="queue")
    eventually(lambda: console.health().counters["records_ignored"] == 2, what="ignored records")


@pytest.mark.parametrize("error", [OverflowError("too large"), sqlite3.IntegrityError("NOT NULL constraint failed")])
def test_a_record_that_fails_ends_no_batch(start, monkeypatch, error):
    console = start(role="shore")
    store_image = contacts.store_image

    def fail(db, image, *options):
        if image.image_id == "0003":
            raise error
        return store_image(db, image, *options)

    monkeypatch.setattr(contacts, "store_image", fail)
    records = [image_record(f"{number:04}") for number in range(7)]
    console._store_batch(records)
    counters = console.health().counters
    assert (counters["images_taken"], counters["records_failed"]) == (6, 1)
    assert console.state.counts().total == 6
    [kept] = console.store.quarantined()
    assert (kept.size_bytes, kept.can_be_queued) == (len(wire.encode(records[3])), False)
    assert str(error) in kept.reason


@pytest.mark.parametrize("error", [MemoryError("none"), OSError(28, "No space left on device"), DeliveryError("full")])
def test_records_of_c2_are_stored_after_a_failure_has_passed(start, client, monkeypatch, error):
    monkeypatch.setattr("sonarpost.services.console.service.UPDATE_INTERVAL_S", 0.1)
    Site(client, *(image_record(f"{number:04}") for number in range(3)))
    with monkeypatch.context() as patched:

        def fail(*_):
            raise error

        patched.setattr(contacts, "store_image", fail)
        console = start(role="shore")
        eventually(lambda: str(error) in console.health().detail, what="degraded")
        assert console.store.states("cursor") == {}
    eventually(lambda: console.state.counts().total == 3, what="images")
    eventually(lambda: console.health().state == "ok", what="recovery")


def test_records_of_c2_are_not_stored_below_the_disk_reserve(start, client, monkeypatch):
    monkeypatch.setattr("sonarpost.services.console.service.UPDATE_INTERVAL_S", 0.1)
    monkeypatch.setattr("sonarpost.runtime.service.HANDLING_RESERVE_BYTES", 1 << 62)
    Site(client, image())
    console = start(role="shore")
    eventually(lambda: "below the reserve" in console.health().detail, what="degraded")
    assert console.state.counts().total == 0
    console._disk_reserve._reserve_bytes = 0
    eventually(lambda: console.state.counts().total == 1, what="image")
    eventually(lambda: console.health().state == "ok", what="recovery")


def test_fleet_state_that_fails_degrades_health_until_it_is_published_again(start, monkeypatch):
    console = start()
    with monkeypatch.context() as patched:
        patched.setattr(console.state, "fleet_state", lambda: 1 / 0)
        eventually(lambda: "fleet state not published" in console.degraded_reason(), what="degraded")
    eventually(lambda: console.degraded_reason() == "", what="recovery")


def test_empty_relay_means_delivery_to_shore(start, client, runner, monkeypatch, log_in):
    monkeypatch.setattr("sonarpost.services.console.service.SHORE_DELIVERY_MARGIN_S", -1.0)
    relay = runner.peer(VESSEL, "relay", {keys.contact_decision(VESSEL): Decision})
    console = start(decision_consumers=("relay",))
    put(client, keys.image_reconstructed(VESSEL), image())
    anna = log_in(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts").json()["total"] == 1, what="image")
    anna.decide(ID).json()["decision"]
    eventually(lambda: anna.contact(ID)["contact"]["delivery"]["shore"] == "relay", what="acknowledgement of the relay")
    health = relay.health()
    # The health of the peer has no gauge for decisions, so that its own records change nothing.
    for gauges, at, shore_state in (
        ({"inbox": 0.0, "decisions_waiting": 1.0}, 60, "relay"),
        ({"inbox": 1.0, "decisions_waiting": 0.0}, 60, "relay"),
        ({"inbox": 0.0, "decisions_waiting": 0.0}, -60, "relay"),
        ({"inbox": 0.0, "decisions_waiting": 0.0}, 60, "delivered"),
    ):
        console._on_relay_health(health.model_copy(update={"gauges": gauges, "time_utc_s": time.time() + at}))
        assert anna.contact(ID)["contact"]["delivery"]["shore"] == shore_state


def test_request_is_sent_to_the_modem(start_with_image, runner):
    modem = runner.peer(VESSEL, "op_modem", {keys.command_all(VESSEL): Command})
    _, anna = start_with_image(lambda: image(1, complete=False), decision_consumers=())
    asked = anna.post(f"/api/contacts/{ID}/requests", {"kind": "resend", "airtime_s": 9.3}).json()
    eventually(lambda: len(modem.received) == 1, what="request")
    sent = modem.received[0]
    assert (sent.command_id, sent.image_id, sent.issued_by) == (asked["command_id"], "00A7", "anna")
    eventually(lambda: anna.contact(ID)["requests"][0]["state"] == "asked", what="acknowledgement")
    decision = anna.decide(ID).json()["decision"]
    assert (decision["delivery"]["shore"], decision["delivery"]["vehicle"]) == ("none", "none")


def test_comment_from_the_shore_site_is_shown(start_with_image, runner):
    _, anna = start_with_image()
    relay = runner.peer(VESSEL, "relay")
    relay.send(keys.comment(VESSEL), "console", comment_record())
    eventually(lambda: anna.contact(ID)["contact"]["commented"], what="comment")
    assert anna.contact(ID)["comments"][0]["remark"] == "look again"


def test_received_frames_are_assigned_to_their_vehicle(start, client, log_in):
    console = start(vehicles={"3": "uuv-1"})
    anna = log_in(console, "anna", "observer")
    frame = received_frame(quality=LinkQuality(snr_in_db=12.5, frames=3, bad_frames=1))
    put(client, keys.acoustic_rx(VESSEL), frame)
    eventually(lambda: len(anna.get("/api/fleet").json()["vehicles"]) == 1, what="vehicle")
    [vehicle] = anna.get("/api/fleet").json()["vehicles"]
    assert (vehicle["vehicle_id"], vehicle["snr_in_db"], vehicle["loss"]) == ("uuv-1", 12.5, 0.333)

    def services():
        return {service["service"] for service in anna.get("/api/fleet").json()["services"]}

    eventually(lambda: "console" in services(), what="own health")


def test_status_of_a_vehicle_is_shown_and_invalid_records_and_those_of_another_vessel_are_ignored(start, client):
    console = start()
    record = SAMPLES["received-status"]
    assert isinstance(record, ReceivedStatus)
    foreign = record.model_copy(update={"vessel_id": "vessel-9"})
    publish_once(client, keys.acoustic_status(VESSEL), wire.encode(foreign))
    eventually(lambda: console.health().counters.get("records_ignored") == 1, what="ignored record")
    publish_once(client, keys.acoustic_downlink(VESSEL), b"\xc1")
    eventually(lambda: console.health().counters.get("records_ignored") == 2, what="invalid record")
    publish_once(client, keys.acoustic_status(VESSEL), wire.encode(record.model_copy(update={"vessel_id": VESSEL})))
    eventually(lambda: console.state.fleet_state()["vehicles"] != [], what="vehicle")
    [vehicle] = console.state.fleet_state()["vehicles"]
    assert (vehicle["vehicle_id"], vehicle["lat_deg"]) == ("uuv-1", 41.5251)


def test_image_of_another_vessel_is_refused(start, client, refused):
    console = start()
    other = image().model_copy(update={"vessel_id": "vessel-2"})
    put(client, keys.image_reconstructed(VESSEL), other)
    eventually(lambda: console.health().counters.get("records_refused") == 1, what="refusal")
    assert "vessel_id" in refused(console)[0][1]
    assert console.state.counts().total == 0


def test_shore_console_shows_images_of_c2_and_sends_comments_to_it(runner, start, client, log_in):
    c2 = runner.peer("shore-1", "c2", {keys.tasking_comment_all(): Comment, keys.tasking_command_all(): Command})
    site = Site(client, image())
    console = start(role="shore")
    eva = log_in(console, "eva", "expert")
    eventually(lambda: eva.get("/api/contacts").json()["total"] == 1, what="image")
    body = {"version": 1, "verdict": "unsure", "remark": "shadow too long"}
    comment = eva.post(f"/api/contacts/{ID}/comment", body).json()
    eventually(lambda: len(c2.received) == 1, what="comment")
    assert (c2.received[0].comment_id, c2.received[0].author) == (comment["comment_id"], "eva")
    state = TaskingState(
        vessel_id=VESSEL, kind="comment", record_id=comment["comment_id"], state="delivered", changed_utc_s=time.time()
    )
    put(client, keys.tasking_state(VESSEL), state)
    eventually(lambda: eva.contact(ID)["comments"][0]["delivery"]["state"] == "delivered", what="state")
    site.accept(decision_record(image_id="00A7"))
    eventually(lambda: eva.contact(ID)["contact"]["review"] == "mine_like", what="decision")
    assert eva.contact(ID)["decisions"][0]["delivery"]["shore"] == "delivered"


def stored(console):
    """Return what the database has of the images and decisions."""
    with console.state.database.read() as db:
        images = [tuple(row) for row in db.execute("SELECT contact_id, version, payload FROM version ORDER BY 1, 2")]
        rows = db.execute("SELECT id, image, review, decided_by FROM contact ORDER BY id")
        return images, [tuple(row) for row in rows]


def test_missed_records_give_the_same_state_as_live_ones(runner, start, platform, tmp_path):
    c2 = runner.start(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out")))
    relay = runner.peer(VESSEL, "relay")
    partial = image(1, complete=False)
    pixels = partial.pixels.to_array()
    pixels[0, 0] = pixels[35, 5] = 0  # black: received, and in a row with missing pixels
    packed = Pixels.from_array(pixels)
    partial = partial.model_copy(update={"pixels": packed, "pixels_sha256": packed.sha256})
    records = [image_record("00A8"), partial, image(2), image_record("00A9", missing_rows=3)]
    records.append(decision_record(image_id="00A7", vessel_id=VESSEL))

    def send(some):
        for record in some:
            relay.send(keys.shore_inbox(VESSEL), "c2", relayed(record))

    def is_stored(console, count):
        images, contacts = stored(console)
        return len(images) == count and (count < 4 or any(row[2] == "mine_like" for row in contacts))

    live = runner.start(ConsoleService(platform("shore-2"), ConsoleConfig(port=0, role="shore")))
    console = start(role="shore")
    send(records[:1])
    eventually(lambda: is_stored(console, 1), what="first image")
    runner.stop(console)
    send(records[1:])
    eventually(lambda: is_stored(live, 4), what="live records")
    runner.stop(c2)  # it makes its records from the files again
    for path in (tmp_path / "out").glob("archive.db*"):
        path.unlink()
    runner.start(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out")))
    console = start(role="shore")
    eventually(lambda: is_stored(console, 4), what="missed records")
    assert stored(console) == stored(live)
    assert (console.state.image(ID, 1).missing() == partial.missing()).all()


def test_record_of_another_vessel_than_its_key_is_ignored(start, client):
    site = Site(client)
    console = start(role="shore")
    payload = msgpack.packb({**wire.map_of(image()), "accepted": {"archive": "0000000a", "seq": 1, "utc_s": 1.0}})
    publish_once(client, keys.shore_image("vessel-2"), payload)
    eventually(lambda: console.health().counters.get("records_ignored") == 1, what="ignored record")
    site.accept(decision_record(image_id="00A7"), image_record("00A7"))
    eventually(lambda: console.state.counts().total == 1, what="image")


def test_failed_query_does_not_stop_the_shore_console(start, client, monkeypatch):
    poll = CatchUpSubscriber.poll
    errors = [zenoh.ZError("not sent")]

    def fail_once(self, timeout_s):
        if errors:
            raise errors.pop()
        return poll(self, timeout_s)

    monkeypatch.setattr(CatchUpSubscriber, "poll", fail_once)
    Site(client, image())
    console = start(role="shore")
    eventually(lambda: console.stopping.is_set() or console.state.counts().total == 1, what="image")
    assert console.state.counts().total == 1


def test_decision_is_sent_after_a_restart(start_with_image, runner, start, log_in):
    console, anna = start_with_image()
    decision = anna.decide(ID).json()["decision"]
    runner.stop(console)
    again = start()
    relay = runner.peer(VESSEL, "relay", {keys.contact_decision(VESSEL): Decision})
    eventually(lambda: len(relay.received) == 1, what="decision after the restart")
    assert relay.received[0].decision_id == decision["decision_id"]
    bo = log_in(again, "bo", "operator")
    assert bo.contact(ID)["contact"]["review"] == "mine_like"
    assert [entry["user"] for entry in bo.contact(ID)["audit"]] == ["anna"]


def test_stored_decision_is_sent_after_a_crash(start_with_image, runner, start, monkeypatch):
    console, anna = start_with_image()
    # Simulates a crash between the two transactions.
    monkeypatch.setattr(console, "_send", lambda _item: console.stopping.wait())
    decision = anna.decide(ID).json()["decision"]
    runner.stop(console)
    start()
    relay = runner.peer(VESSEL, "relay", {keys.contact_decision(VESSEL): Decision})
    eventually(lambda: [d.decision_id for d in relay.received] == [decision["decision_id"]], what="decision")


def test_missing_certificate_and_occupied_port_are_errors(platform, start):
    with pytest.raises(ConfigError, match="certificate"):
        ConsoleService(platform("vessel-2"), ConsoleConfig(tls=True))
    first = start()
    port = int(first.address.rstrip("/").rpartition(":")[2])
    second = ConsoleService(platform("vessel-3"), ConsoleConfig(port=port))
    with pytest.raises(PortError, match="cannot be bound"):
        second.start()
    second.stop()


def test_health_and_liveliness_token(start, check_monitoring):
    check_monitoring(start())


def test_delivery_to_shore_with_the_real_relay(runner, start, client, platform, log_in):
    relay = runner.start(RelayService(platform(VESSEL), RelayConfig()))
    console = start(decision_consumers=("relay",))
    put(client, keys.image_reconstructed(VESSEL), image())
    anna = log_in(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts").json()["total"] == 1, what="image")
    anna.decide(ID).json()["decision"]
    eventually(lambda: relay.gauges()["decisions_waiting"] == 1.0, what="decision at the relay")
    eventually(lambda: anna.contact(ID)["contact"]["delivery"]["shore"] == "relay", what="acknowledgement of the relay")
    c2 = runner.peer("shore-1", "c2", {keys.shore_inbox_all(): Relayed})
    eventually(lambda: anna.contact(ID)["contact"]["delivery"]["shore"] == "delivered", what="delivery to shore")
    assert keys.contact_decision(VESSEL) in [envelope.key for envelope in c2.received]


@pytest.fixture
def restartable_router():
    """A router that a test stops and starts; the endpoint of `router` is not used."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    sessions = []

    start = lambda: sessions.append(zenoh.open(router_config([endpoint])))  # noqa: E731
    yield SimpleNamespace(endpoint=endpoint, start=start, stop=lambda: sessions.pop().close())
    for session in sessions:
        session.close()


def chain(browser):
    return {link["place"]: link["state"] for link in browser.get("/api/fleet").json()["chain"]}


def service_states(browser):
    return {one["service"]: one["state"] for one in browser.get("/api/fleet").json()["services"]}


def test_page_is_served_without_a_router_and_records_arrive_when_it_comes(platform, restartable_router, log_in):
    settings = platform(VESSEL).model_copy(update={"router": (restartable_router.endpoint,)})
    console = ConsoleService(settings, ConsoleConfig(port=0))
    console.state.store_image(image_record("0001"))
    starting = threading.Thread(target=console.start)
    starting.start()
    try:
        eventually(lambda: console.address != "", what="web server")
        anna = log_in(console, "anna", "operator")
        # A contact on the disk is shown, and a decision on it is stored and queued.
        [row] = anna.get("/api/contacts").json()["items"]
        assert anna.decide(row["id"]).status_code == 201
        eventually(lambda: console.store.outbox_depth() == 2, what="queued decision")
        assert chain(anna)["router"] == "lost"
        eventually(lambda: service_states(anna).get("console") == "degraded", what="own health")
        assert anna.get("/api/fleet").json()["listening_since_utc_s"] is None

        restartable_router.start()
        eventually(lambda: chain(anna)["router"] == "ok", what="router")
        with zenoh.open(client_config([restartable_router.endpoint])) as client:
            put(client, keys.image_reconstructed(VESSEL), image())
            eventually(lambda: anna.get("/api/contacts").json()["total"] == 2, what="image")
        eventually(lambda: service_states(anna)["console"] == "ok", what="own health")
    finally:
        console.stop()
        starting.join()


def test_lost_router_is_shown_and_found_again(platform, runner, restartable_router, log_in):
    restartable_router.start()
    settings = platform(VESSEL).model_copy(update={"router": (restartable_router.endpoint,)})
    console = runner.start(ConsoleService(settings, ConsoleConfig(port=0)))
    anna = log_in(console, "anna", "operator")
    eventually(lambda: chain(anna)["router"] == "ok", what="router")
    eventually(lambda: service_states(anna).get("console") == "ok", what="own health")
    restartable_router.stop()
    eventually(lambda: chain(anna)["router"] == "lost", what="loss of the router")
    eventually(lambda: service_states(anna)["console"] == "degraded", what="own health")
    assert chain(anna)["modem"] == "unknown"
    restartable_router.start()
    eventually(lambda: chain(anna)["router"] == "ok", what="router")
    # The subscriptions are valid again.
    with zenoh.open(client_config([restartable_router.endpoint])) as client:

        def is_stored():
            put(client, keys.image_reconstructed(VESSEL), image())
            return anna.get("/api/contacts").json()["total"] == 1

        eventually(is_stored, what="image")


def test_service_that_ends_is_shown_by_its_place(runner, start, log_in):
    modem = runner.peer(VESSEL, "op_modem")
    console = start()
    anna = log_in(console, "anna", "observer")
    eventually(lambda: chain(anna)["modem"] == "ok", what="modem")
    # A killed process publishes no last health: its token ends with its session.
    modem.session.close()
    eventually(lambda: chain(anna)["modem"] == "lost", what="loss of op_modem")


def test_service_that_does_not_reach_a_router_stops(platform, restartable_router):
    settings = platform(VESSEL).model_copy(update={"router": (restartable_router.endpoint,)})
    console = ConsoleService(settings, ConsoleConfig(port=0))
    starting = threading.Thread(target=console.start)
    starting.start()
    eventually(lambda: console.address != "", what="web server")
    address = console.address
    assert httpx2.get(f"{address}login", timeout=120).status_code == 200
    console.stop()
    starting.join(timeout=120)
    assert not starting.is_alive()
    with pytest.raises(httpx2.ConnectError):
        httpx2.get(address)
