"""`sonarpost c2 alert`: live contacts for a webhook and an MQTT broker."""

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
from contextlib import closing
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace

import pytest
from builders.common import WAIT_S, eventually, free_port
from builders.exports import Clock, contact_of, decision, image
from builders.shore import Site
from builders.unreached_router import check_unreached_router
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion

from sonarpost.cli.main import main
from sonarpost.errors import DeliveryError, PortError
from sonarpost.export.live import LiveContacts
from sonarpost.extensions.alerts import command, senders
from sonarpost.extensions.alerts.command import AlertService, SentAlerts, alert_document, needs_alert, score
from sonarpost.extensions.alerts.senders import AlertNotAcceptedError, AlertRefusedError, AlertWebhook, Mqtt, signature
from sonarpost.network import http_client
from sonarpost.security.client_tls import TlsFiles
from sonarpost.security.fleet import CA_CERTIFICATE, CERTIFICATE, KEY, Fleet

SECRET = b"0123456789abcdef"


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
    monkeypatch.setattr(command, "MAX_WAITING", 2)
    monkeypatch.setattr(command, "MAX_SENT", 2)
    sent = SentAlerts(tmp_path / "state.db")
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
        assert sender.times_s[0] <= added_s + command.MAX_NOT_ACCEPTED_RETRY_S
        assert sender.times_s[4] <= added_s + 4 * command.MAX_NOT_ACCEPTED_RETRY_S
        # An alert that was not tried before precedes the failed ones of its vessel.
        assert contact_of("0200", "vessel-2").uid in sender.ids
        assert len(sender.ids) == 6
        refused.clear()
        run(600)
        assert len(sender.ids) == 56


def test_waiting_alerts_have_places_by_vessel(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(command, "MAX_WAITING", 3)
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


def test_alert_that_fails_ends_no_batch(monkeypatch, tmp_path):
    def fails_for_0001(contact, sent_utc):
        return 1 / 0 if contact.image.image_id == "0001" else alert_document(contact, sent_utc)

    monkeypatch.setattr(command, "alert_document", fails_for_0001)
    alerts, clock = Alerts(), Clock()
    with closing(SentAlerts(tmp_path / "sent.db")) as sent:
        service = AlertService(alerts, sent, 0.0, clock=clock)
        for n in (1, 2):
            service.add(contact_of(f"{n:04}", f"vessel-{n}"))
        assert not service.send_due()
        clock.now_s += 1
        assert service.send_due()
    assert [alert_id[-4:] for alert_id in alerts.ids] == ["0002"]


def test_foreign_state_file_is_an_error(tmp_path):
    path = tmp_path / "state.db"
    path.write_bytes(b"not a database" * 100)
    with pytest.raises(DeliveryError, match=r"state\.db: cannot be opened"):
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


def test_silent_receiver_is_given_up(monkeypatch):
    monkeypatch.setattr(senders, "http_client", SimpleNamespace(post=partial(http_client.post, timeout_s=0.01)))
    with socket.create_server(("127.0.0.1", 0)) as silent:
        webhook = AlertWebhook(f"http://127.0.0.1:{silent.getsockname()[1]}", TlsFiles(), None)
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


def test_alert_command_reads_the_stored_contacts_and_the_key(hook, router, client, tmp_path):
    Site(client, image("0001"), image("0002", {"atd_confidence": 0.1}))
    secret = tmp_path / "secret"
    secret.write_bytes(SECRET + b"\n")
    arguments = ["alert", "--webhook", f"http://127.0.0.1:{hook.server_port}", "--state", str(tmp_path / "state.db")]
    arguments += ["--secret-file", str(secret), "--router", router, "--stored"]
    hook.statuses.append(503)
    process = subprocess.Popen([sys.executable, "-m", "sonarpost.cli.main", "c2", *arguments], env=dict(os.environ))
    try:
        eventually(lambda: len(hook.received) == 2)
        uid = contact_of("0001").uid
        assert {json.loads(body)["id"] for _, _, body in hook.received} == {uid}
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
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


def test_unreached_router_is_reported(tmp_path):
    check_unreached_router(f"c2 alert --webhook http://127.0.0.1:9 --state {tmp_path}/alerts.db")


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


def test_mqtt_alert_reaches_a_subscriber(broker, monkeypatch):
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
        wrong = Mqtt(f"mqtt://ben@127.0.0.1:{port}/mines/alerts", TlsFiles(), SECRET)
        monkeypatch.setattr(senders, "TIMEOUT_S", 0.5)
        with pytest.raises(PortError, match="not"):
            wrong.send("id", "vessel-1", body)
        process.kill()
        process.wait()
        with pytest.raises(PortError, match="not"):
            sender.send("id", "vessel-1", body)
    finally:
        sender.close()
        client.loop_stop()
