"""Decisions of the console: take-back time, undo, disputes, overruling, notices, classes."""

import pytest
from builders.console import Clock, comment_record, contact_id, image_record
from builders.records import decision_record
from pydantic import ValidationError

from sonarpost import wire
from sonarpost.errors import BadInputError
from sonarpost.messages import Decision
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.store import decisions
from sonarpost.services.console.store.database import Database

ID = contact_id()


@pytest.fixture
def clock(console):
    console.state.store_image(image_record())
    return Clock(console, 1_800_000_000.0)


def sent(console):
    """Queue all records that can be sent; return decision identifier and verdict, and whether the vehicle gets it."""
    items = console.state.unsent_records()
    for item in items:
        console.state.mark_sent(item)
    assert all(isinstance(item.record, Decision) for item in items)
    return [(item.record.decision_id, item.record.verdict, item.to_vehicle) for item in items]


def test_decision_is_sent_after_the_take_back_time(console, clock):
    anna = console.browser("anna")
    decision = anna.decide(ID).json()["decision"]
    assert decision["take_back_utc_s"] == clock.now_utc_s + 8.0
    clock.advance(7.9)
    assert sent(console) == []
    clock.advance(0.1)
    assert sent(console) == [(decision["decision_id"], "mine_like", True)]
    assert sent(console) == []
    assert anna.contact(ID)["decisions"][0]["take_back_utc_s"] is None


def test_record_that_cannot_be_decoded_delays_no_other(console, clock):
    console.state.store_image(image_record("00A8"))
    anna = console.browser("anna")
    for image_id in ("00A7", "00A8"):
        assert anna.decide(contact_id(image_id)).status_code == 201
    clock.advance(8.0)
    with console.state.database.transaction() as db:
        db.execute("UPDATE decision SET payload = x'c1' WHERE image_id = '00A7'")
        db.execute("UPDATE version SET payload = x'c1' WHERE contact_id = ?", (ID,))
    assert [item.record.image_id for item in console.state.unsent_records()] == ["00A8"]
    table = anna.get("/api/export/contacts.csv")
    assert ("00A7" in table.text, "00A8" in table.text) == (False, True)
    assert anna.get("/report").text.count("class='sheet'") == 1
    console.state.config = console.state.config.model_copy(update={"max_bytes": 0})
    assert console.state.remove_images(clock.now_utc_s) == 2
    assert anna.get("/api/contacts").json()["total"] == 2


def test_decision_is_stored_and_shown_with_all_fields_of_its_record(console, clock):
    class LongerDecision(Decision):
        further: str = "kept"

    record = decision_record(image_id="00A7", image_version=1, overrules=("d-0",), withdraws="d-9", remark="a boulder")
    assert console.state.store_decision(LongerDecision.model_validate(record.model_dump()))
    with console.state.database.read() as db:
        [stored] = db.execute("SELECT payload FROM decision").fetchone()
    assert wire.decode(LongerDecision, stored, "decision") == LongerDecision.model_validate(record.model_dump())
    [shown] = console.browser("anna").contact(ID)["decisions"]
    shown |= {"image_version": shown["version"], "withdraws": shown["undoes"], "overrules": tuple(shown["overrules"])}
    of_contact = {"vessel_id", "vehicle_id", "image_id"}
    fields = record.model_dump(exclude=of_contact)
    assert fields == {name: shown[name] for name in Decision.model_fields if name not in of_contact}


def test_decisions_without_images_are_limited_for_each_vessel(console, clock, monkeypatch):
    monkeypatch.setattr(decisions, "MAX_WAITING", 3)
    records = [
        decision_record(image_id=f"B00{number}", decision_id=f"d-{number}", decided_utc_s=1.7e9) for number in range(4)
    ]
    for record in records[:3]:
        assert console.state.store_decision(record)
    with pytest.raises(BadInputError, match="3 others have none yet"):
        console.state.store_decision(records[3])
    assert console.state.store_decision(records[3].model_copy(update={"vessel_id": "vessel-2", "decision_id": "d-9"}))
    console.state.store_image(image_record("B000"))
    assert console.state.store_decision(records[3])


def test_comments_without_images_are_limited(console, monkeypatch):
    monkeypatch.setattr(decisions, "MAX_WAITING", 3)
    for number in range(3):
        console.state.store_comment(comment_record(f"B00{number}", comment_id=f"a-{number}"))
    with pytest.raises(BadInputError, match="3 others have none yet"):
        console.state.store_comment(comment_record("B003", comment_id="a-3"))
    console.state.store_image(image_record("B000"))
    console.state.store_comment(comment_record("B003", comment_id="a-3"))


def test_decision_taken_back_in_time_is_not_sent(console, clock):
    anna = console.browser("anna")
    decision = anna.decide(ID).json()["decision"]
    clock.advance(7.9)
    answer = anna.undo(ID, decision["decision_id"])
    assert answer.status_code == 201, answer.text
    assert answer.json()["contact"]["review"] == "unreviewed"
    clock.advance(3600)
    assert sent(console) == []
    # Nothing is deleted.
    withdrawal, first = anna.contact(ID)["decisions"]
    assert (withdrawal["undoes"], first["undone"]) == (decision["decision_id"], True)
    assert {one["delivery"][way] for one in (withdrawal, first) for way in ("shore", "vehicle")} == {"withdrawn"}
    assert [entry["action"] for entry in anna.contact(ID)["audit"]] == ["decide", "undo"]


def test_kept_decision_survives_a_restart(console, clock):
    decision = console.browser("anna").decide(ID).json()["decision"]
    path = console.state.database.path
    console.state.database.close()
    console.state.database = Database(path)
    clock.advance(8.0)
    assert [item[0] for item in sent(console)] == [decision["decision_id"]]


def test_clock_that_is_set_back_does_not_keep_a_decision(console, clock):
    decision = console.browser("anna").decide(ID).json()["decision"]
    clock.advance(-3600)
    assert [item[0] for item in sent(console)] == [decision["decision_id"]]
    # Released for sending: from now on an undo is sent too, also if the clock is before the take-back time.
    answer = console.browser("anna").undo(ID, decision["decision_id"]).json()["decision"]
    assert [item[0] for item in sent(console)] == [answer["decision_id"]]


def test_undo_after_the_take_back_time_is_sent_and_restores_the_previous_verdict(console, clock):
    anna = console.browser("anna")
    first = anna.decide(ID).json()["decision"]
    second = anna.decide(ID, verdict="unsure").json()["decision"]
    clock.advance(10)
    assert [item[1] for item in sent(console)] == ["mine_like", "unsure"]
    # The first decision is replaced by the second one: it cannot be undone before it.
    assert anna.undo(ID, first["decision_id"]).json()["error"]["field"] == "decision_id"
    undone = anna.undo(ID, second["decision_id"]).json()
    assert (undone["contact"]["review"], undone["decision"]["undoes"]) == ("mine_like", second["decision_id"])
    first_undone = anna.undo(ID, first["decision_id"]).json()
    assert (first_undone["contact"]["review"], first_undone["decision"]["verdict"]) == ("unreviewed", "unsure")
    assert [item[1] for item in sent(console)] == ["mine_like", "unsure"]
    assert len(anna.contact(ID)["decisions"]) == len(anna.contact(ID)["audit"]) == 4


def test_undo_is_audited_with_the_image_on_the_screen(console, clock):
    anna = console.browser("anna")
    decision = anna.decide(ID).json()["decision"]
    console.state.store_image(image_record(version=2))
    second = anna.contact(ID)["versions"][1]["sha256"]
    assert second != decision["sha256"]
    # The digest of another version is refused.
    assert anna.undo(ID, decision["decision_id"], sha256=decision["sha256"]).json()["error"]["field"] == "sha256"
    assert anna.undo(ID, decision["decision_id"], layer="expand").status_code == 201
    entry = anna.contact(ID)["audit"][-1]
    assert [entry[name] for name in ("action", "version", "sha256", "layer")] == ["undo", 2, second, "expand"]


def test_only_own_decisions_can_be_undone(console, clock):
    anna, bo = console.browser("anna"), console.browser("bo")
    decision = anna.decide(ID).json()["decision"]
    answer = bo.undo(ID, decision["decision_id"])
    assert (answer.status_code, answer.json()["error"]["field"]) == (400, "decision_id")
    assert bo.undo(ID, "d-unknown").status_code == 400
    assert anna.contact(ID)["contact"]["review"] == "mine_like"


def test_last_own_decision_of_any_contact(console, clock):
    console.state.store_image(image_record("00A8", seed=1))
    other = ID.replace("00A7", "00A8")
    anna, bo = console.browser("anna"), console.browser("bo")
    assert anna.get("/api/decisions/last").json() == {"decision": None, "contact": None}
    decisions = [browser.decide(name).json()["decision"] for browser, name in ((anna, ID), (anna, other), (bo, ID))]
    last = anna.get("/api/decisions/last").json()
    assert (last["decision"]["decision_id"], last["contact"]["id"]) == (decisions[1]["decision_id"], other)
    anna.undo(other, decisions[1]["decision_id"])
    assert anna.get("/api/decisions/last").json()["contact"]["id"] == ID
    clock.advance(12 * 3600 + 1)
    assert anna.get("/api/decisions/last").json()["decision"] is None


def test_differing_verdicts_are_kept_as_disputed(console, clock):
    anna, bo = console.browser("anna"), console.browser("bo")
    first = anna.decide(ID, revision=0).json()["decision"]
    # The page of the second operator does not yet show the first decision.
    answer = bo.decide(ID, revision=0, verdict="not_mine_like")
    assert (answer.status_code, answer.json()["contact"]["review"]) == (201, "disputed")
    second = answer.json()["decision"]
    entry = anna.contact(ID)["audit"][-1]
    assert entry["detail"]["verdict"] == "not_mine_like"
    named = {"decision_id": first["decision_id"], "operator": "anna", "verdict": "mine_like"}
    assert entry["detail"]["disputes"] == [named]
    # It counts as mine-like, in lists and for the vehicle.
    assert [row["id"] for row in anna.get("/api/contacts", review="mine_like").json()["items"]] == [ID]
    assert [row["id"] for row in anna.get("/api/contacts", review="disputed").json()["items"]] == [ID]
    assert anna.get("/api/contacts", review="not_mine_like").json()["items"] == []
    clock.advance(8)
    records = [(first["decision_id"], "mine_like", True), (second["decision_id"], "not_mine_like", False)]
    assert sent(console) == records
    assert bo.contact(ID)["decisions"][0]["delivery"]["vehicle"] == "disputed"
    # The first operator receives a notice until the dispute is settled.
    [notice] = anna.get("/api/notices").json()["notices"]
    shown = [notice[name] for name in ("kind", "name", "operator", "verdict")]
    assert shown == ["disputed", "uuv-1/00A7", "bo", "not_mine_like"]
    assert bo.get("/api/notices").json()["notices"] == []
    assert bo.undo(ID, second["decision_id"]).json()["contact"]["review"] == "mine_like"
    assert anna.get("/api/notices").json()["notices"] == []


def test_decision_with_a_later_one_of_another_operator_is_sent_before_its_undo(console, clock):
    anna, bo = console.browser("anna"), console.browser("bo")
    first = anna.decide(ID).json()["decision"]
    bo.decide(ID, verdict="not_mine_like")
    assert anna.undo(ID, first["decision_id"]).json()["contact"]["review"] == "not_mine_like"
    clock.advance(8)
    # The vehicle receives the verdict that counts, although the record of the dispute was not sent to it.
    assert [item[1] for item in sent(console) if item[2]] == ["mine_like", "not_mine_like"]


def test_overruling_needs_a_reason_and_is_announced_to_the_overruled_operator(console, clock):
    anna, bo = console.browser("anna"), console.browser("bo")
    first = anna.decide(ID).json()["decision"]
    for reason in ("", "  "):
        assert bo.decide(ID, verdict="not_mine_like", overrules=True, remark=reason).status_code == 400
    assert anna.contact(ID)["contact"]["review"] == "mine_like"
    assert (
        bo.decide(ID, verdict="mine_like", overrules=True, remark="the same verdict").json()["error"]["field"]
        == "overrules"
    )
    stale = bo.decide(ID, verdict="not_mine_like", overrules=True, remark="a boulder", revision=0)
    assert (stale.status_code, stale.json()["error"]["code"]) == (409, "conflict")
    answer = bo.decide(ID, verdict="not_mine_like", overrules=True, remark="a boulder").json()
    assert (answer["contact"]["review"], answer["decision"]["overrules"]) == ("not_mine_like", [first["decision_id"]])
    entry = anna.contact(ID)["audit"][-1]
    assert (entry["action"], entry["user"], entry["detail"]["remark"]) == ("overrule", "bo", "a boulder")
    assert [one["operator"] for one in entry["detail"]["overrules"]] == ["anna"]
    [notice] = anna.get("/api/notices").json()["notices"]
    assert (notice["kind"], notice["operator"], notice["remark"]) == ("overruled", "bo", "a boulder")
    path = f"/api/notices/{notice['id']}/acknowledge"
    assert bo.post(path, {}).status_code == 404
    assert anna.post(path, {}).status_code == 204
    assert anna.post(f"/api/notices/{10**30}/acknowledge", {}).status_code == 404
    assert anna.get("/api/notices").json()["notices"] == []
    assert anna.contact(ID)["audit"][-1]["action"] == "acknowledge"


def test_observer_has_no_decision_to_undo_or_acknowledge(console, clock):
    watch = console.browser("watch")
    assert watch.get("/api/decisions/last").json()["decision"] is None
    assert watch.post("/api/notices/1/acknowledge", {}).status_code == 403


def test_image_response_has_the_digest_that_a_decision_states(console, clock):
    anna = console.browser("anna")
    path = f"/api/contacts/{ID}/versions/1/image.png"
    for layer in ("raw", "expand"):
        digest = anna.get(path, layer=layer).headers["X-Image-SHA256"]
        assert digest == anna.contact(ID)["versions"][0]["sha256"]
    assert anna.decide(ID, sha256=digest).status_code == 201


def test_classes_are_a_list_or_a_table_of_groups(make_console):
    flat = make_console(classes=("manta", "rockan")).browser("watch").get("/api/info").json()["classes"]
    assert flat == [{"group": "", "classes": ["manta", "rockan"]}]
    groups = {"MILCO": ("manta",), "NOMBO": ("rock", "debris")}
    assert make_console(classes=groups).browser("watch").get("/api/info").json()["classes"] == [
        {"group": "MILCO", "classes": ["MILCO", "MILCO > manta"]},
        {"group": "NOMBO", "classes": ["NOMBO", "NOMBO > rock", "NOMBO > debris"]},
    ]
    for classes in ({"x" * 21: ("a",)}, {"MILCO": ("k" * 37,)}, ("",), ("c" * 61,)):
        with pytest.raises(ValidationError):
            ConsoleConfig(classes=classes)
    longest = ConsoleConfig(classes={"x" * 20: ("k" * 36,)}).class_groups()["x" * 20][1]
    assert len(longest) <= 60
