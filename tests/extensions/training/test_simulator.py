"""Training: simulated contacts, their packets, requests and decisions."""

import time
from itertools import islice

import pytest

from sonarpost.cli.main import main
from sonarpost.errors import ConfigError
from sonarpost.extensions.training.contacts import simulated_contacts
from sonarpost.extensions.training.simulator import VESSEL, TrainingSimulator


def test_number_of_contacts_is_limited(capsys):
    for number in ("0", "100001"):
        assert main(["console", "training", number]) == 2
        assert "1 to 100000" in capsys.readouterr().err


def test_simulated_contacts_arrive_in_versions_and_are_marked():
    contacts = list(islice(simulated_contacts(3, 1_700_000_000.0), 8))
    assert {contact.codec.name for contact in contacts} == {"emb", "vq"}
    assert len({contact.image_id for contact in contacts}) == 8
    for contact in contacts:
        records = [contact.record(VESSEL, step, 1000.0, 1001.0) for step in range(len(contact.versions))]
        assert [record.version for record in records] == list(range(1, len(records) + 1))
        assert all("simulated, for training" in record.notes for record in records)
        assert records[0].bytes_received < records[0].bytes_total
        received = [record.bytes_received for record in records]
        assert received == sorted(received)
        # With the codec of the paper, a half of the image arrives first.
        assert records[0].missing_fraction == pytest.approx(0.5 if contact.codec.name == "vq" else 0.0, abs=0.1)


def test_training_delivers_decisions_and_requests(console):
    simulator = TrainingSimulator(console.state, contacts=3, interval_s=0.01)
    simulator.load_backlog(2)
    assert console.state.counts().total == 2
    anna = console.browser("anna")
    [contact_id] = [row["id"] for row in anna.get("/api/contacts", limit=1).json()["items"]]
    anna.decide(contact_id)
    # The decision is sent after the time in which it can be taken back.
    now = time.time() + console.state.config.take_back_s
    console.state.clock = lambda: now
    simulator.accept_records(now)
    for later, state in ((0.0, "asked"), (5.0, "sent"), (11.0, "confirmed")):
        simulator.advance_downlink(now + later)
        delivery = anna.get(f"/api/contacts/{contact_id}").json()["contact"]["delivery"]
        assert delivery["vehicle"] == state
    assert delivery["shore"] == "delivered"
    detail = anna.get(f"/api/contacts/{contact_id}").json()["contact"]
    kind = "resend" if not detail["complete"] else "refine"
    assert anna.post(f"/api/contacts/{contact_id}/requests", {"kind": kind}).status_code == 201
    simulator.accept_records(now)
    simulator.advance_downlink(now + 11.0)
    for _ in range(10):
        simulator.receive_packet(time.time())
    more = anna.get(f"/api/contacts/{contact_id}").json()["contact"]
    assert more["complete"]
    assert (more["version"], more["bytes_received"] > detail["bytes_received"]) == (detail["version"] + 1, True)
    assert console.state.counts().total == 3
    assert any(row["commented"] for row in anna.get("/api/contacts").json()["items"])
    vehicles = anna.get("/api/fleet").json()["vehicles"]
    assert any(vehicle["snr_in_db"] is not None and vehicle["queue"] for vehicle in vehicles)


def test_training_continues_after_a_restart_with_the_same_seed(console):
    def start(contacts: int, seed: int = 1) -> TrainingSimulator:
        simulator = TrainingSimulator(console.state, contacts, seed, interval_s=0.01)
        simulator.load_backlog(contacts * 2 // 3)
        return simulator

    anna = console.browser("anna")
    listed = lambda: {row["id"]: row for row in anna.get("/api/contacts").json()["items"]}  # noqa: E731
    first = start(3)
    first.receive_packet(time.time())  # the first of several versions
    before = listed()
    assert len(before) == 3
    anna.decide(anna.get("/api/contacts", sort="name", order="asc").json()["items"][0]["id"])
    now = time.time() + console.state.config.take_back_s
    console.state.clock = lambda: now
    first.accept_records(now)
    for _ in range(2):
        again = start(3)
        assert listed().keys() == before.keys()
    # What was in progress continues: the image of the third contact, and the decision.
    for _ in range(8):
        again.receive_packet(time.time())
    again.advance_downlink(time.time() + 11.0)
    rows = listed()
    assert rows.keys() == before.keys()
    assert sum(row["version"] for row in rows.values()) > sum(row["version"] for row in before.values())
    assert sum((row["delivery"] or {}).get("vehicle") == "confirmed" for row in rows.values()) == 1
    # More contacts are of the same survey.
    start(6)
    added = [row for row in listed().values() if row["id"] not in before]
    assert len(added) == 1
    assert abs(added[0]["seen_utc_s"] - max(row["seen_utc_s"] for row in before.values())) < 600
    with pytest.raises(ConfigError, match="--seed"):
        start(3, seed=2)


@pytest.mark.parametrize("kind", ["expand", "original"])
def test_training_sends_a_new_image_once(kind, console):
    simulator = TrainingSimulator(console.state, contacts=1, interval_s=0.01)
    simulator.load_backlog(1)
    anna = console.browser("anna")

    def ask(contact_id: str, expected: int = 201) -> None:
        assert anna.post(f"/api/contacts/{contact_id}/requests", {"kind": kind}).status_code == expected
        now = time.time()
        simulator.accept_records(now)
        simulator.advance_downlink(now + 11.0)
        for _ in range(10):
            simulator.receive_packet(time.time())

    [contact] = anna.get("/api/contacts").json()["items"]
    ask(contact["id"])
    assert anna.get("/api/contacts").json()["total"] == 1  # a layer of its contact
    detail = anna.contact(contact["id"])
    [related] = detail["related"]
    assert (related["relation"], related["image_id"]) == (kind, "ZZZZ")
    known, new = (console.state.image(contact_id, 1) for contact_id in (contact["id"], related["id"]))
    scale = 2 if kind == "expand" else 1
    assert new.contact.pixel_along_m == scale * known.contact.pixel_along_m
    assert new.contact.pixel_across_m == scale * known.contact.pixel_across_m
    assert (known.despeckle_strength, new.despeckle_strength) == (1.0, 1.0 if kind == "expand" else 0.0)
    version = related["versions"][-1]
    assert (version["complete"], version["stage"]) == (True, "sent")
    [request] = detail["requests"]
    assert request["result"] == {"id": related["id"], "version": version["version"], "bytes": version["bytes_received"]}
    assert request["arrived_utc_s"] is not None
    ask(contact["id"], expected=400)  # the image is here
    ask(related["id"], expected=400)
