"""The console service with its neighbours: received records, sent records, health."""

from __future__ import annotations

import json
import threading
import time
import urllib.request
from http.client import HTTPResponse
from typing import Any

import numpy as np
import pytest
import zenoh
from builders.common import eventually, publish_once

from sonarpost import keys, wire
from sonarpost.archive.image_files import write_image
from sonarpost.errors import ConfigError, PortError
from sonarpost.messages import (
    AcousticFrame,
    Advice,
    Command,
    Contact,
    Decision,
    DownlinkState,
    LinkQuality,
    Pixels,
    ReconstructedImage,
    Relayed,
    TaskingState,
)
from sonarpost.runtime.process import main
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.service import ConsoleService
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

PASSWORD = "correct horse battery"
VESSEL = "vessel-1"
ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def image(version: int = 1, *, complete: bool = True) -> ReconstructedImage:
    pixels = np.full((20, 20), 100 + version, np.uint8)
    raster = Pixels.from_array(pixels)
    mask = np.zeros(pixels.shape, np.bool_)
    mask[10:] = not complete
    return ReconstructedImage(
        vessel_id=VESSEL,
        vehicle_id="uuv-1",
        image_id="00A7",
        version=version,
        contact=Contact(contact_id="uuv-1/00A7", vehicle_id="uuv-1", lat_deg=56.0, lon_deg=-5.0),
        codec="emb",
        model="",
        picture=raster,
        picture_sha256=raster.sha256,
        complete=complete,
        missing_fraction=float(mask.mean()),
        missing_mask=b"" if complete else np.packbits(mask).tobytes(),
        missing_halves=(),
        bytes_received=128 if complete else 64,
        bytes_total=128,
        frames_received=version,
        first_frame_utc_s=1_700_000_000.0,
        last_frame_utc_s=1_700_000_000.0,
    )


class Page:
    """A browser with a session at a running console service."""

    def __init__(self, console: ConsoleService, user: str, role: str) -> None:
        self.base = console.address
        console._users.add(user, role, PASSWORD)
        answer, headers = self._ask("/api/login", {"user": user, "password": PASSWORD}, {})
        self.headers = {"Cookie": headers["set-cookie"].partition(";")[0], "X-CSRF-Token": answer["csrf"]}

    def _ask(self, path: str, body: Any, headers: dict[str, str]) -> tuple[Any, Any]:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self.base.rstrip("/") + path, data, headers)
        with urllib.request.urlopen(request, timeout=20) as answer:
            return json.load(answer), answer.headers

    def get(self, path: str) -> Any:
        return self._ask(path, None, self.headers)[0]

    def post(self, path: str, body: Any) -> Any:
        return self._ask(path, body, self.headers)[0]

    def contact(self) -> Any:
        return self.get(f"/api/contacts/{ID}")

    def decide(self, **changes: Any) -> Any:
        detail = self.contact()
        version = detail["versions"][-1]
        body = {"revision": detail["contact"]["revision"], "version": version["version"], "sha256": version["sha256"]}
        return self.post(f"/api/contacts/{ID}/decisions", {**body, "verdict": "mine_like", **changes})["decision"]

    def events(self) -> tuple[HTTPResponse, list[tuple[str, Any]]]:
        """Read the event stream in a thread until it is closed."""
        request = urllib.request.Request(self.base + "events", None, self.headers)
        stream, found = urllib.request.urlopen(request, timeout=60), []

        def read() -> None:
            name = ""
            try:
                for raw in stream:
                    line = raw.decode().rstrip("\n")
                    if line.startswith("event: "):
                        name = line.removeprefix("event: ")
                    elif line.startswith("data: "):
                        found.append((name, json.loads(line.removeprefix("data: "))))
            except (OSError, ValueError, AttributeError):
                return  # closed

        threading.Thread(target=read, daemon=True).start()
        return stream, found


@pytest.fixture(autouse=True)
def fast_password_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sonarpost.services.console.store.users.SCRYPT_COST", 2**4)


@pytest.fixture
def start(runner, platform):
    def make(**options: Any) -> ConsoleService:
        side = options.get("side", "vessel")
        config = ConsoleConfig(port=0, **options)
        return runner.start(ConsoleService(platform(VESSEL if side == "vessel" else "shore-1"), config))

    return make


def put(client: zenoh.Session, key: str, record: Any) -> None:
    publish_once(client, key, wire.encode(record), wire.encoding_of(type(record)))


def test_images_are_published_and_a_decision_is_sent_to_relay_and_modem(runner, start):
    relay = runner.peer(VESSEL, "relay", {keys.contact_decision(VESSEL): Decision})
    modem = runner.peer(
        VESSEL, "op_modem", {keys.contact_decision(VESSEL): Decision, keys.command_all(VESSEL): Command}
    )
    decompressor = runner.peer(VESSEL, "decompressor")
    console = start()
    anna = Page(console, "anna", "operator")
    stream, events = anna.events()
    eventually(lambda: [name for name, _ in events] == ["hello"], what="stream")
    key = keys.image_reconstructed(VESSEL)
    decompressor.send(key, "console", image(1, complete=False))
    eventually(lambda: any(name == "contact" and data["new"] for name, data in events), what="contact")
    decompressor.send(key, "console", image(2))
    eventually(lambda: any(name == "contact" and data["contact"]["complete"] for name, data in events), what="refined")
    decision = anna.decide(remark="clean edge")
    eventually(lambda: len(relay.received) == len(modem.received) == 1, what="decision handed on")
    assert relay.received == modem.received
    assert (relay.received[0].decision_id, relay.received[0].operator, relay.received[0].image_version) == (
        decision["decision_id"],
        "anna",
        2,
    )

    def delivery() -> Any:
        return anna.contact()["contact"]["delivery"]

    eventually(lambda: (delivery()["shore"], delivery()["vehicle"]) == ("relay", "asked"), what="receipts")
    stream.close()


def test_delivery_state_of_a_decision_is_updated(runner, start, client):
    for name in ("relay", "op_modem"):
        runner.peer(VESSEL, name, {keys.contact_decision(VESSEL): Decision})
    console = start()
    put(client, keys.image_reconstructed(VESSEL), image())
    anna = Page(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts")["total"] == 1, what="picture")
    decision = anna.decide()
    eventually(lambda: anna.contact()["contact"]["delivery"]["vehicle"] == "asked", what="receipt")
    state = DownlinkState(
        vessel_id=VESSEL,
        vehicle_id="uuv-1",
        kind="decision",
        record_id=decision["decision_id"],
        state="confirmed",
        times_sent=2,
        expires_utc_s=time.time() + 100,
        changed_utc_s=time.time() + 1,
    )
    put(client, keys.acoustic_downlink(VESSEL), state)
    eventually(lambda: anna.contact()["contact"]["delivery"]["vehicle"] == "confirmed", what="confirmation")
    eventually(lambda: anna.contact()["contact"]["delivery"]["shore"] == "relay", what="relay's receipt")


def test_empty_relay_means_delivery_to_shore(start, client, runner, monkeypatch):
    monkeypatch.setattr("sonarpost.services.console.service.SHORE_DELIVERY_MARGIN_S", -1.0)
    relay = runner.peer(VESSEL, "relay", {keys.contact_decision(VESSEL): Decision})
    console = start(decision_consumers=("relay",))
    put(client, keys.image_reconstructed(VESSEL), image())
    anna = Page(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts")["total"] == 1, what="picture")
    anna.decide()
    eventually(lambda: anna.contact()["contact"]["delivery"]["shore"] == "relay", what="relay's receipt")
    health = relay.health()
    # The neighbour says nothing of decisions, so nothing is concluded from its own records.
    for gauges, at, ashore in (
        ({"inbox": 0.0, "decisions_waiting": 1.0}, 60, "relay"),
        ({"inbox": 1.0, "decisions_waiting": 0.0}, 60, "relay"),
        ({"inbox": 0.0, "decisions_waiting": 0.0}, -60, "relay"),
        ({"inbox": 0.0, "decisions_waiting": 0.0}, 60, "delivered"),
    ):
        console._on_relay_health(health.model_copy(update={"gauges": gauges, "time_utc_s": time.time() + at}))
        assert anna.contact()["contact"]["delivery"]["shore"] == ashore


def test_request_is_sent_to_the_modem(runner, start, client):
    modem = runner.peer(VESSEL, "op_modem", {keys.command_all(VESSEL): Command})
    console = start(decision_consumers=())
    put(client, keys.image_reconstructed(VESSEL), image(1, complete=False))
    anna = Page(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts")["total"] == 1, what="picture")
    asked = anna.post(f"/api/contacts/{ID}/requests", {"kind": "resend", "airtime_s": 9.3})
    eventually(lambda: len(modem.received) == 1, what="request")
    assert (modem.received[0].command_id, modem.received[0].image_id, modem.received[0].issued_by) == (
        asked["command_id"],
        "00A7",
        "anna",
    )
    eventually(lambda: anna.contact()["requests"][0]["state"] == "asked", what="receipt")
    decision = anna.decide()
    assert (decision["delivery"]["shore"], decision["delivery"]["vehicle"]) == ("none", "none")


def test_comment_from_the_shore_site_is_shown(runner, start, client):
    console = start()
    put(client, keys.image_reconstructed(VESSEL), image())
    relay = runner.peer(VESSEL, "relay")
    anna = Page(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts")["total"] == 1, what="picture")
    names = {"vessel_id": VESSEL, "vehicle_id": "uuv-1", "image_id": "00A7", "image_version": 1}
    advice = Advice(advice_id="a-1", author="eva", advised_utc_s=time.time(), remark="look again", **names)
    relay.send(keys.advice(VESSEL), "console", advice)
    eventually(lambda: anna.contact()["contact"]["advised"], what="advice")
    assert anna.contact()["advice"][0]["remark"] == "look again"


def test_received_frames_are_assigned_to_their_vehicle(start, client):
    console = start(vehicles={"3": "uuv-1"})
    anna = Page(console, "anna", "observer")
    frame = AcousticFrame(
        direction="rx",
        platform_id=VESSEL,
        time_utc_s=time.time(),
        source=3,
        destination=1,
        rate=1,
        packet=1,
        frame_number=1,
        frame_count=3,
        data=b"x",
        quality=LinkQuality(snr_in_db=12.5, frames=3, bad_frames=1),
    )
    put(client, keys.acoustic_rx(VESSEL), frame)
    eventually(lambda: len(anna.get("/api/fleet")["vehicles"]) == 1, what="vehicle")
    [vehicle] = anna.get("/api/fleet")["vehicles"]
    assert (vehicle["vehicle_id"], vehicle["snr_in_db"], vehicle["loss"]) == ("uuv-1", 12.5, 0.333)
    eventually(lambda: any(s["service"] == "console" for s in anna.get("/api/fleet")["services"]), what="own health")


def test_invalid_record_is_counted_and_ignored(start, client):
    console = start()
    publish_once(client, keys.acoustic_downlink(VESSEL), b"\xc1")
    eventually(lambda: console.health().counters.get("records_ignored") == 1, what="ignored record")


def test_image_of_another_vessel_is_refused(start, client, refused):
    console = start()
    other = image().model_copy(update={"vessel_id": "vessel-2"})
    put(client, keys.image_reconstructed(VESSEL), other)
    eventually(lambda: console.health().counters.get("records_refused") == 1, what="refusal")
    assert "vessel_id" in refused(console)[0][1]
    assert console.state.counts().total == 0


def test_shore_console_shows_images_of_c2_and_sends_comments_to_it(runner, start, client):
    c2 = runner.peer("shore-1", "c2", {keys.tasking_advice_all(): Advice, keys.tasking_command_all(): Command})
    console = start(role="shore")
    put(client, keys.shore_image(VESSEL), image())
    eva = Page(console, "eva", "expert")
    eventually(lambda: eva.get("/api/contacts")["total"] == 1, what="picture")
    advice = eva.post(f"/api/contacts/{ID}/advice", {"version": 1, "verdict": "unsure", "remark": "shadow too long"})
    eventually(lambda: len(c2.received) == 1, what="advice")
    assert (c2.received[0].advice_id, c2.received[0].author) == (advice["advice_id"], "eva")
    state = TaskingState(
        vessel_id=VESSEL, kind="advice", record_id=advice["advice_id"], state="delivered", changed_utc_s=time.time()
    )
    put(client, keys.tasking_state(VESSEL), state)
    eventually(lambda: eva.contact()["advice"][0]["delivery"]["state"] == "delivered", what="state")
    names = {"vessel_id": VESSEL, "vehicle_id": "uuv-1", "image_id": "00A7", "image_version": 1}
    decision = Decision(decision_id="d-1", verdict="mine_like", operator="anna", decided_utc_s=time.time(), **names)
    put(client, keys.shore_decision(VESSEL), decision)
    eventually(lambda: eva.contact()["contact"]["review"] == "mine_like", what="decision")
    assert eva.contact()["decisions"][0]["delivery"]["shore"] == "delivered"


def test_shore_console_reads_missed_records_from_the_folder_of_c2(start, tmp_path):
    write_image(tmp_path / "out" / VESSEL, image(2, complete=False))
    (tmp_path / "out" / VESSEL / "broken.json").write_text("{")
    console = start(role="shore", out_dir=tmp_path / "out")
    eventually(lambda: console.state.counts().total == 1, what="kept picture")
    kept = console.state.image(ID, 2)
    assert (kept.missing() == image(2, complete=False).missing()).all()
    assert kept.picture == image(2).picture


def test_decision_is_sent_after_a_restart(runner, start, client):
    console = start()
    put(client, keys.image_reconstructed(VESSEL), image())
    anna = Page(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts")["total"] == 1, what="picture")
    decision = anna.decide()
    runner.stop(console)
    again = start()
    relay = runner.peer(VESSEL, "relay", {keys.contact_decision(VESSEL): Decision})
    eventually(lambda: len(relay.received) == 1, what="decision after the restart")
    assert relay.received[0].decision_id == decision["decision_id"]
    bo = Page(again, "bo", "operator")
    assert bo.contact()["contact"]["review"] == "mine_like"
    assert [entry["user"] for entry in bo.contact()["audit"]] == ["anna"]


def test_stored_decision_is_sent_after_a_crash(runner, start, client, monkeypatch):
    console = start()
    put(client, keys.image_reconstructed(VESSEL), image())
    anna = Page(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts")["total"] == 1, what="picture")
    # Simulates a crash between the two transactions.
    monkeypatch.setattr(console, "_send", lambda _item: console.stopping.wait())
    decision = anna.decide()
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


def test_health_token_and_last_word(start, check_monitoring):
    check_monitoring(start())


def test_invalid_configuration_ends_the_process(tmp_path, capsys):
    path = tmp_path / "vessel.toml"
    path.write_text('[platform]\nid = "vessel-1"\n[console]\nhost = "0.0.0.0"\n')
    assert main(ConsoleService, ConsoleConfig, ["--config", str(path)]) == 2
    assert "passwords are sent over this connection" in capsys.readouterr().err


def test_delivery_to_shore_with_the_real_relay(runner, start, client, platform):
    relay = runner.start(RelayService(platform(VESSEL), RelayConfig()))
    console = start(decision_consumers=("relay",))
    put(client, keys.image_reconstructed(VESSEL), image())
    anna = Page(console, "anna", "operator")
    eventually(lambda: anna.get("/api/contacts")["total"] == 1, what="picture")
    anna.decide()
    eventually(lambda: relay.gauges()["decisions_waiting"] == 1.0, what="decision at the relay")
    eventually(lambda: anna.contact()["contact"]["delivery"]["shore"] == "relay", what="relay's receipt")
    c2 = runner.peer("shore-1", "c2", {keys.shore_inbox_all(): Relayed})
    eventually(lambda: anna.contact()["contact"]["delivery"]["shore"] == "delivered", what="ashore")
    assert keys.contact_decision(VESSEL) in [envelope.key for envelope in c2.received]
