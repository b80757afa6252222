"""`sonarpost c2 cot` and `alert`: live contacts for a TAK endpoint, a webhook and an MQTT broker."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import os
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
import warnings
from configparser import ConfigParser
from contextlib import closing
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import pytest
import xmlschema
import zenoh
from builders.common import REPOSITORY, WAIT_S, eventually, free_port, publish_once
from builders.exports import decision, image, store
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from sonarpost import keys, wire
from sonarpost.bus.session import client_config, router_config
from sonarpost.cli.c2 import alert as alert_module
from sonarpost.cli.c2 import live as live_module
from sonarpost.cli.c2 import tak as tak_module
from sonarpost.cli.c2 import watch as watch_module
from sonarpost.cli.c2.alert import AlertService, SentAlerts
from sonarpost.cli.c2.alert_senders import AlertNotAcceptedError, AlertRefusedError, AlertWebhook, Mqtt
from sonarpost.cli.c2.live import ContactChange, ContactStream
from sonarpost.cli.c2.tak import MAX_IMAGES, REFRESH_S, RETRY_S, CotService
from sonarpost.cli.main import main
from sonarpost.errors import PortError, StoredFileError
from sonarpost.export.alerts import alert_document, needs_alert, score, signature
from sonarpost.export.contacts import load_contacts
from sonarpost.export.live import LiveContacts
from sonarpost.export.tak.cot_sender import TlsFiles
from sonarpost.export.tak.data_package import UploadedPackage, attachment_sha256
from sonarpost.export.tak.tak_files import PackageRefusedError
from sonarpost.security.fleet import CA_CERTIFICATE, CERTIFICATE, KEY, Fleet

SECRET = b"0123456789abcdef"


def contact_of(image_id="00A7", vessel_id="vessel-1", **fields):
    found = LiveContacts().add(image(image_id, fields, vessel_id=vessel_id))
    assert found is not None
    return found


class Clock:
    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


# Contacts of a site


class PublishedRecords:
    """A session whose only subscriber receives the given records."""

    def __init__(self):
        self.info = SimpleNamespace(routers_zid=lambda: ["router"])
        self.publish = None

    def declare_subscriber(self, key, on_sample):
        self.publish = on_sample


def test_vessels_have_places_and_turns_of_their_own(monkeypatch):
    monkeypatch.setattr(watch_module, "MAX_WAITING", 10)
    session = PublishedRecords()
    watch = watch_module.RecordSubscription(session, keys.SHORE, None)
    for vessel, count in (("vessel-2", 50), ("vessel-1", 3)):
        for number in range(count):
            record = decision(f"{number:04d}", vessel_id=vessel)
            payload = SimpleNamespace(to_bytes=lambda record=record: wire.encode(record))
            session.publish(
                SimpleNamespace(kind=zenoh.SampleKind.PUT, key_expr=keys.shore_decision(vessel), payload=payload)
            )
    assert watch.gaps == 40
    order = [watch.poll().vessel_id for _ in range(13)]
    assert order[:6].count("vessel-1") == 3
    assert watch.poll() is None


def test_stream_reads_the_folder_first_and_after_an_interruption(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    hub = zenoh.open(router_config([endpoint]))
    folder = store(tmp_path / "out", image("0001"), image("0002", vessel_id="vessel-2"))
    session = zenoh.open(client_config([endpoint]))
    changes = []

    def poll():
        changes.extend(stream.poll())
        return [change.contact.image.image_id for change in changes]

    try:
        stream = ContactStream(session, keys.SHORE, "vessel-1", folder)
        eventually(lambda: poll() == ["0001"])
        assert changes[0].png == (folder / "vessel-1").glob("*.png").__next__().read_bytes()
        publish_once(hub, keys.shore_image("vessel-1"), wire.encode(image("0001", version=2)))
        eventually(lambda: poll() == ["0001", "0001"])
        publish_once(hub, keys.shore_decision("vessel-1"), wire.encode(decision("0001")))
        eventually(lambda: poll() == ["0001", "0001", "0001"])
        assert changes[2].contact.review == "mine_like"
        assert changes[2].png is None
        hub.close()
        store(folder, image("0003"))  # accepted while this program was not connected
        eventually(lambda: poll() == ["0001"] * 3 and not session.info.routers_zid())
        hub = zenoh.open(router_config([endpoint]))
        eventually(lambda: poll() == ["0001"] * 3 + ["0003"])
    finally:
        session.close()
        hub.close()


# TAK


class Events:
    """Stands for the connection to a TAK server."""

    endpoint = "tcp://tak:8087"

    def __init__(self):
        self.batches = []
        self.is_down = False
        self.delivered = 0

    def send(self, events, give_up_after_s):
        assert give_up_after_s == 0
        if self.is_down:
            raise PortError("tak: down")
        self.batches.append([ET.fromstring(event) for event in events])
        self.delivered += len(events)
        return "delivered"


class Files:
    """Stands for the HTTP interface of a TAK server."""

    def __init__(self, order):
        self.is_down = False
        self.names = []
        self._order = order

    def upload(self, name, package, creator):
        if self.is_down:
            raise PortError("tak: status 500")
        self.names.append(name)
        self._order.append("upload")
        return UploadedPackage("http://tak/content", hashlib.sha256(package).hexdigest(), len(package))


def test_event_is_repeated_and_refreshed():
    sender, clock = Events(), Clock()
    service = CotService(sender, None, clock=clock)
    service.add(ContactChange(contact_of(), b"png"))
    service.add(ContactChange(contact_of(lat_deg=None), b"png"))
    times = []
    for _ in range(700):
        if service.send_due():
            times.append(clock.now_s - 100)
        clock.now_s += 1
    assert times == [0, 5, 30, REFRESH_S]
    assert {len(batch) for batch in sender.batches} == {1}
    assert sender.batches[0][0].find("detail/attachment_list") is None


def test_image_is_registered_before_its_event_is_sent():
    order = []
    sender, clock = Events(), Clock()
    files = Files(order)
    send = sender.send
    sender.send = lambda events, give_up_after_s: order.append("events") or send(events, give_up_after_s)
    service = CotService(sender, files, clock=clock)
    service.add(ContactChange(contact_of(), b"png"))
    assert service.send_due() == 1
    assert order == ["upload", "events"]
    [event, transfer] = sender.batches[0]
    assert event.find("detail/attachment_list").attrib["hashes"] == f'["{attachment_sha256(b"png")}"]'
    assert transfer.attrib["type"] == "b-f-t-r"
    clock.now_s += 5
    service.send_due()
    clock.now_s += 30
    service.send_due()
    clock.now_s += REFRESH_S
    service.send_due()
    # Clients would download the package again with every refresh.
    assert [len(batch) for batch in sender.batches] == [2, 2, 2, 1]
    assert files.names == ["uuv-1_00A7_v1.zip"]


def test_failures_are_tried_again():
    sender, clock, files = Events(), Clock(), Files([])
    sender.is_down = files.is_down = True
    service = CotService(sender, files, clock=clock)
    service.add(ContactChange(contact_of(), b"png"))
    assert service.send_due() == 0
    sender.is_down = False
    assert service.send_due() == 0  # waits before the next attempt
    clock.now_s += RETRY_S[0]
    assert service.send_due() == 1
    assert len(sender.batches[0]) == 1  # without its image
    files.is_down = False
    clock.now_s += 30
    assert service.send_due() == 1
    assert len(sender.batches[1]) == 2


def test_memory_is_limited():
    sender, clock = Events(), Clock()
    files = Files([])
    service = CotService(sender, files, clock=clock, max_contacts=MAX_IMAGES + 10)
    for n in range(MAX_IMAGES + 30):
        service.add(ContactChange(contact_of(f"{n:04}"), b"png"))
    assert service.send_due() == MAX_IMAGES + 10
    assert len(files.names) == MAX_IMAGES


def test_contacts_and_images_have_places_by_vessel():
    sender, files = Events(), Files([])
    service = CotService(sender, files, clock=Clock(), max_contacts=MAX_IMAGES)
    service.add(ContactChange(contact_of("0000"), b"png"))
    for n in range(MAX_IMAGES + 30):
        service.add(ContactChange(contact_of(f"{n:04}", "vessel-2"), b"png"))
    service.send_due()
    # The vessel with one contact is first, and has kept its place and its image.
    assert sender.batches[0][0].attrib["uid"].endswith("0000")
    assert len(files.names) == MAX_IMAGES
    live = LiveContacts(max_names=3)
    for image_id, vessel in (("0000", "vessel-1"), *((f"{n:04}", "vessel-2") for n in range(9))):
        live.add(image(image_id, vessel_id=vessel))
    names = [(contact.image.vessel_id, contact.image.image_id) for contact in live.located(9)]
    assert names == [("vessel-1", "0000"), ("vessel-2", "0007"), ("vessel-2", "0008")]


def test_refused_package_delays_no_other():
    sender, files = Events(), Files([])
    upload = files.upload

    def refuse(name, package, creator):
        if "0001" in name:
            raise PackageRefusedError("status 500")
        return upload(name, package, creator)

    files.upload = refuse
    service = CotService(sender, files, clock=Clock())
    for n in range(1, 4):
        service.add(ContactChange(contact_of(f"{n:04}"), b"png"))
    assert service.send_due() == 3
    assert [("0002" in name, "0003" in name) for name in files.names] == [(True, False), (False, True)]


def test_contact_that_fails_ends_no_stream_and_no_batch(monkeypatch, tmp_path):
    def fails_for_0001(function, id_of):
        return lambda given, *words: 1 / 0 if id_of(given) == "0001" else function(given, *words)

    def image_id(contact):
        return contact.image.image_id

    sender, alerts, clock = Events(), Alerts(), Clock()
    cot = CotService(sender, None, clock=Clock())
    with closing(SentAlerts(tmp_path / "sent.db")) as sent:
        service = AlertService(alerts, sent, 0.0, clock=clock)
        monkeypatch.setattr(tak_module, "cot_event", fails_for_0001(tak_module.cot_event, image_id))
        monkeypatch.setattr(alert_module, "alert_document", fails_for_0001(alert_document, image_id))
        for n in (1, 2):
            cot.add(ContactChange(contact_of(f"{n:04}"), None))
            service.add(contact_of(f"{n:04}", f"vessel-{n}"))
        assert cot.send_due() == 2
        assert [[event.attrib["uid"][-4:] for event in batch] for batch in sender.batches] == [["0002"]]
        assert not service.send_due()
        clock.now_s += 1
        assert service.send_due()
        assert [alert_id[-4:] for alert_id in alerts.ids] == ["0002"]
    session = PublishedRecords()
    stream = ContactStream(session, keys.SHORE, None, None)
    monkeypatch.setattr(live_module, "_png_of", fails_for_0001(live_module._png_of, lambda record: record.image_id))
    for n in (1, 2):
        payload = SimpleNamespace(to_bytes=lambda n=n: wire.encode(image(f"{n:04}")))
        key = keys.shore_image("vessel-1")
        session.publish(SimpleNamespace(kind=zenoh.SampleKind.PUT, key_expr=key, payload=payload))
    assert stream.poll() == []
    assert [change.contact.image.image_id for change in stream.poll()] == ["0002"]


def start(*arguments):
    return subprocess.Popen([sys.executable, "-m", "sonarpost.cli.main", "c2", *arguments], env=dict(os.environ))


def interrupt(process):
    process.send_signal(signal.SIGINT)
    assert process.wait() == 0


@pytest.mark.system
def test_cot_command_sends_events_across_a_restart_of_the_server(router, client, tmp_path):
    """pytak reads the events; the schema of the base event accepts them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it can use aiohttp for enrolment, which this test does not need
        import pytak

    folder = store(tmp_path / "out", image("0001"))
    port = free_port()
    received = []

    async def read(until):
        """Accept one connection, and read events with pytak until `until` was received."""
        done = asyncio.Event()

        async def accept(reader, writer):
            config = ConfigParser()
            config["tak"] = {}
            queue = asyncio.Queue()
            worker = pytak.RXWorker(queue, config["tak"], reader)
            while not done.is_set():
                await worker.run_once()
                while not queue.empty():
                    received.append(ET.fromstring(queue.get_nowait()))
                if any(event.attrib["uid"].endswith(until) for event in received):
                    done.set()
            writer.close()

        async with await asyncio.start_server(accept, "127.0.0.1", port):
            await asyncio.wait_for(done.wait(), WAIT_S)

    process = start("cot", f"tcp://127.0.0.1:{port}", "--router", router, "--archive", str(folder))
    try:
        asyncio.run(read("0001"))
        publish_once(client, keys.shore_image("vessel-1"), wire.encode(image("0002")))
        asyncio.run(read("0002"))
        interrupt(process)
    finally:
        process.kill()
        process.wait()
    schema = xmlschema.XMLSchema(REPOSITORY / "tests" / "export" / "cot_event.xsd")
    for event in received:
        schema.validate(event)


def test_cot_command_rejects_invalid_addresses(capsys):
    assert main(["c2", "cot", "http://tak"]) == 2
    assert "CoT endpoint" in capsys.readouterr().err
    assert main(["c2", "cot", "tcp://tak:8087", "--tak-api", "tak"]) == 2
    assert "TAK server" in capsys.readouterr().err


# Alerts


def test_score():
    for fields, expected in (
        ({"p_mine_like": 0.7, "p_other_object": 0.1}, 0.7),
        ({"atd_confidence": 1.5}, 0.75),
        ({"atd_confidence": None}, None),
    ):
        contact = contact_of(**fields)
        assert score(contact) == expected
        assert needs_alert(contact, 0.7) == (expected is not None)
        assert not needs_alert(contact, 0.76)


def test_verdict_counts_more_than_the_detector():
    for verdict, expected in (("mine_like", True), ("not_mine_like", False), ("unsure", False)):
        live = LiveContacts()
        live.add(image())
        assert needs_alert(live.add(decision(verdict=verdict)), 1.0) == expected


class Alerts:
    """Stands for a receiver."""

    def __init__(self, *errors):
        self.ids = []
        self.errors = list(errors)

    def send(self, alert_id, vessel_id, body):
        document = json.loads(body)
        assert (document["id"], document["contact"]["vessel_id"]) == (alert_id, vessel_id)
        if self.errors:
            raise self.errors.pop(0)
        self.ids.append(alert_id)

    def close(self):
        pass


def test_alert_is_sent_once_over_restarts(tmp_path):
    sender = Alerts()
    for _ in range(2):
        sent = SentAlerts(tmp_path / "state.db")
        service = AlertService(sender, sent, 0.5)
        service.add(contact_of())
        service.add(contact_of())
        while service.send_due():
            pass
        sent.close()
    assert sender.ids == [contact_of().uid]


def test_failed_alert_is_repeated_and_a_refused_one_is_not(tmp_path):
    clock = Clock()
    sender = Alerts(PortError("down"), PortError("down"), AlertRefusedError("no"))
    sent = SentAlerts(tmp_path / "state.db")
    service = AlertService(sender, sent, 0.5, clock=clock)
    service.add(contact_of("0001"))
    service.add(contact_of("0002"))
    assert not service.send_due()
    assert not service.send_due()  # waits
    clock.now_s += 1
    assert not service.send_due()
    clock.now_s += 1
    assert not service.send_due()  # the pause is longer now
    clock.now_s += 1
    assert service.send_due()  # refused
    assert service.send_due()
    assert sender.ids == [contact_of("0002").uid]
    sent.close()


def test_waiting_alerts_and_state_are_limited(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(alert_module, "MAX_WAITING", 2)
    sent = SentAlerts(tmp_path / "state.db", max_rows=2)
    sender = Alerts()
    service = AlertService(sender, sent, 0.5)
    for n in range(3):
        service.add(contact_of(f"000{n}"))
    assert "too many wait" in caplog.text
    while service.send_due():
        pass
    assert len(sender.ids) == 2
    for n in range(3):
        sent.add(str(n))
    assert ["0" in sent, "1" in sent, "2" in sent] == [False, True, True]
    sent.close()


def test_alerts_that_are_not_accepted_delay_no_other_vessel(tmp_path):
    refused = {contact_of(f"{n:04}", "vessel-2").uid for n in range(50)}

    class Filter(Alerts):
        def send(self, alert_id, vessel_id, body):
            if alert_id in refused:
                raise AlertNotAcceptedError("status 403")
            self.times_s.append(clock.now_s)
            super().send(alert_id, vessel_id, body)

    clock, sender = Clock(), Filter()
    sender.times_s = []
    with closing(SentAlerts(tmp_path / "state.db")) as sent:
        service = AlertService(sender, sent, 0.5, clock=clock)
        for n in range(50):
            service.add(contact_of(f"{n:04}", "vessel-2"))

        def run(duration_s):
            end_s = clock.now_s + duration_s
            while clock.now_s < end_s:
                while service.send_due():
                    pass
                clock.now_s += 1

        run(600)
        for n in range(5):
            service.add(contact_of(f"{n:04}"))
        service.add(contact_of("0200", "vessel-2"))
        added_s = clock.now_s
        run(60)
        assert sender.times_s[0] <= added_s + alert_module.MAX_NOT_ACCEPTED_RETRY_S
        assert sender.times_s[4] <= added_s + 4 * alert_module.MAX_NOT_ACCEPTED_RETRY_S
        # An alert that was not tried before precedes the failed ones of its vessel.
        assert contact_of("0200", "vessel-2").uid in sender.ids
        assert len(sender.ids) == 6
        refused.clear()
        run(600)
        assert len(sender.ids) == 56


def test_waiting_alerts_have_places_by_vessel(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(alert_module, "MAX_WAITING", 3)
    sender = Alerts()
    with closing(SentAlerts(tmp_path / "state.db")) as sent:
        service = AlertService(sender, sent, 0.5)
        for vessel, count in (("vessel-2", 5), ("vessel-1", 3)):
            for n in range(count):
                service.add(contact_of(f"{n:04}", vessel))
        assert caplog.text.count("too many wait") == 2
        while service.send_due():
            pass
    expected = [contact_of(f"{n:04}", vessel).uid for n in range(3) for vessel in ("vessel-1", "vessel-2")]
    assert sender.ids == expected


def test_foreign_state_file_is_an_error(tmp_path):
    path = tmp_path / "state.db"
    path.write_bytes(b"not a database" * 100)
    with pytest.raises(StoredFileError, match="state file"):
        SentAlerts(path)


class Hook(BaseHTTPRequestHandler):
    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.received.append((self.path, dict(self.headers), body))
        self.send_response(self.server.statuses.pop(0) if self.server.statuses else 204)
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def hook():
    server = HTTPServer(("127.0.0.1", 0), Hook)
    server.received, server.statuses = [], []
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


def test_webhook_is_signed(hook):
    contact = contact_of()
    body = alert_document(contact, "2026-01-01T00:00:00.000Z")
    AlertWebhook(f"http://127.0.0.1:{hook.server_port}/in?x=1", TlsFiles(), SECRET).send(contact.uid, "vessel-1", body)
    [(path, headers, received)] = hook.received
    assert (path, headers["X-Sonarpost-Id"], headers["Content-Type"]) == ("/in?x=1", contact.uid, "application/json")
    signed = headers["X-Sonarpost-Timestamp"].encode() + b"." + received
    assert headers["X-Sonarpost-Signature"] == "sha256=" + hmac.new(SECRET, signed, hashlib.sha256).hexdigest()
    assert headers["X-Sonarpost-Signature"] != signature(SECRET, "0", received)
    document = json.loads(received)
    assert (document["type"], document["v"], document["score"]) == ("sonarpost.alert", 1, 0.875)
    assert document["contact"]["lat_deg"] == 41.5251334


@pytest.mark.parametrize(
    ("status", "error"),
    [
        (422, AlertRefusedError),
        (500, AlertNotAcceptedError),
        (302, AlertNotAcceptedError),
        (403, AlertNotAcceptedError),
    ],
)
def test_status_of_the_receiver(status, error, hook):
    hook.statuses.append(status)
    webhook = AlertWebhook(f"http://127.0.0.1:{hook.server_port}", TlsFiles(), None)
    with pytest.raises(PortError, match=str(status)) as caught:
        webhook.send("id", "vessel-1", b"{}")
    assert type(caught.value) is error
    assert "X-Sonarpost-Signature" not in hook.received[0][1]


def test_silent_receiver_is_given_up():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        webhook = AlertWebhook(f"http://127.0.0.1:{silent.getsockname()[1]}", TlsFiles(), None, timeout_s=0.01)
        with pytest.raises(PortError, match="not sent"):
            webhook.send("id", "vessel-1", b"{}")


def test_webhook_verifies_the_certificate(hook, tmp_path):
    folder = Fleet.init(tmp_path / "fleet", "north").issue("shore-1", "shore", ("127.0.0.1",)).folder
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / CERTIFICATE, folder / KEY)
    hook.socket = context.wrap_socket(hook.socket, server_side=True)
    url = f"https://127.0.0.1:{hook.server_port}"
    with pytest.raises(PortError, match="CERTIFICATE_VERIFY_FAILED"):
        AlertWebhook(url, TlsFiles(), None).send("id", "vessel-1", b"{}")
    AlertWebhook(url, TlsFiles(ca=folder / CA_CERTIFICATE), None).send("id", "vessel-1", b"{}")
    assert len(hook.received) == 1


def test_alert_command_reads_the_folder_and_the_key(hook, router, tmp_path):
    folder = store(tmp_path / "out", image("0001"), image("0002", {"atd_confidence": 0.1}))
    secret = tmp_path / "secret"
    secret.write_bytes(SECRET + b"\n")
    arguments = ["alert", "--webhook", f"http://127.0.0.1:{hook.server_port}", "--state", str(tmp_path / "state.db")]
    arguments += ["--secret-file", str(secret), "--router", router, "--archive", str(folder)]
    hook.statuses.append(503)
    process = start(*arguments)
    try:
        eventually(lambda: len(hook.received) == 2)
        uid = load_contacts(folder).contacts[0].uid
        assert {json.loads(body)["id"] for _, _, body in hook.received} == {uid}
        interrupt(process)
        with closing(SentAlerts(tmp_path / "state.db")) as sent:
            assert uid in sent
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ("--webhook ftp://a", "--webhook"),
        ("--webhook https://a:b@c/", "--webhook"),
        ("--mqtt mqtt://a", "a topic without wildcards"),
        ("--mqtt mqtt://a/x/#", "--mqtt"),
        ("--webhook https://a --threshold 2", "--threshold"),
        ("--webhook https://a --secret-file /none", "a readable file"),
        ("--webhook https://a --secret-file /dev/null", "at least 16 bytes"),
        ("--webhook https://a --alert-ca /none", "readable PEM files"),
    ],
)
def test_invalid_options_are_errors(options, text, capsys, tmp_path):
    assert main(["c2", "alert", *options.split(), "--state", str(tmp_path / "state.db")]) == 2
    assert text in capsys.readouterr().err


MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


@pytest.fixture
def broker(tmp_path):
    """A real broker with a password."""
    if MOSQUITTO is None:
        pytest.skip("mosquitto is not installed (apt-get install mosquitto)")
    port = free_port()
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "anna", SECRET.decode()], check=True)
    config = tmp_path / "mosquitto.conf"
    # A broker that runs as root gives up its rights.
    config.write_text(f"listener {port} 127.0.0.1\nallow_anonymous false\npassword_file {passwords}\nuser root\n")
    process = subprocess.Popen([MOSQUITTO, "-c", str(config)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def answers():
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    eventually(answers, what="broker")
    yield port, process
    process.kill()
    process.wait()


def test_mqtt_alert_reaches_a_subscriber(broker):
    port, process = broker
    received = []
    subscribed = threading.Event()
    client = Client(CallbackAPIVersion.VERSION2)
    client.username_pw_set("anna", SECRET.decode())
    client.on_subscribe = lambda *_: subscribed.set()
    client.on_message = lambda _, __, message: received.append((message.topic, message.payload, message.qos))
    client.connect("127.0.0.1", port)
    client.loop_start()
    client.subscribe("mines/alerts/#", qos=1)
    assert subscribed.wait(WAIT_S)
    sender = Mqtt(f"mqtt://anna@127.0.0.1:{port}/mines/alerts", TlsFiles(), SECRET)
    try:
        body = alert_document(contact_of(), "2026-01-01T00:00:00.000Z")
        sender.send("id", "vessel-1", body)
        eventually(lambda: received == [("mines/alerts/vessel-1", body, 1)])
        client.disconnect()
        client.loop_stop()
        wrong = Mqtt(f"mqtt://ben@127.0.0.1:{port}/mines/alerts", TlsFiles(), SECRET, timeout_s=0.5)
        with pytest.raises(PortError, match="not"):
            wrong.send("id", "vessel-1", body)
        process.kill()
        process.wait()
        with pytest.raises(PortError, match="not"):
            sender.send("id", "vessel-1", body)
    finally:
        sender.close()
        client.loop_stop()
