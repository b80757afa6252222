"""Contacts with known objects: nothing is revealed before a decision, nothing about sealed ones is sent, the score."""

import io
import re
import zipfile

import pytest
from builders.console import FIRST_UTC_S, Clock, contact_ids, image_record

from sonarpost.services.console.store.truth import Truth

MINE = Truth(is_mine_like=True, label="cylinder", sealed=True)
ROCK = Truth(is_mine_like=False, label="boulder", sealed=True)


@pytest.fixture
def clock(console):
    return Clock(console)


def add(console, image_id, truth=None, **changes):
    console.state.store_image(image_record(image_id, **changes), truth)
    return contact_ids(console.state)[image_id]


def test_sealed_contact_differs_in_nothing_before_the_decision(console):
    real, sealed = add(console, "00A8"), add(console, "00A7", MINE)
    anna = console.browser("anna")
    one, other = anna.contact(sealed), anna.contact(real)
    assert one.keys() == other.keys()
    assert one["truth"] is None
    assert other["truth"] is None
    assert one["contact"].keys() == other["contact"].keys()
    # Unknown values are those of the other contact too.
    contacts = (one["contact"], other["contact"])
    unknown = [{name for name, value in contact.items() if value is None} for contact in contacts]
    assert unknown[0] == unknown[1]
    for contact in contacts:
        looks = anna.get(f"/api/objects/{contact['object']}").json()["looks"]
        assert [look["contact"]["id"] for look in looks] == [contact["id"]]
    assert "cylinder" not in str(one)
    assert set(contact_ids(console.state)) == {"00A7", "00A8"}


def outputs(console, user):
    """All that a console shows to a user, by request; identifiers and keys of this console are replaced."""
    browser = console.browser(user)
    ids = list(contact_ids(console.state).values())
    lists = [
        f"/api/contacts?{query}" for query in ("", "review=to_do", "q=00", "sort=arrived&limit=1", f"find={ids[0]}")
    ]
    shown = ("fleet", "map", "map/tracks", "score", "notices", "decisions/last", "export")
    details = [f"/api/contacts/{one}" for one in ids]
    exports = [f"/api/export/contacts.{name}" for name in ("csv", "geojson")]
    found = {path: browser.get(path) for path in (*lists, *(f"/api/{one}" for one in shown), *details, *exports)}
    objects = {one["object"] for one in found[lists[0]].json()["items"]}
    found |= {f"/api/objects/{one}": browser.get(f"/api/objects/{one}") for one in objects}
    found |= {path: browser.get(path) for path in ("/report", f"/report/{ids[1]}")}
    assert {answer.status_code for answer in found.values()} == {200}
    found["events"] = [(event.name, event.data) for event in console.state.events.events_after(0)]
    names = ["/".join(sorted(names_of_archive(browser.get("/api/export/contacts.kmz").content)))]
    varying = r'"(decision_id|last_decision|csrf)":"[^"]*"|d-[0-9a-f]{32}|time="[^"]*"|start="[^"]*"|stale="[^"]*"'
    texts = {path: str(getattr(answer, "text", answer)) for path, answer in found.items()} | {"kmz": str(names)}
    return {path: re.sub(varying, "", text) for path, text in texts.items()}


def names_of_archive(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return archive.namelist()


@pytest.mark.system
@pytest.mark.parametrize("user", ["watch", "anna"])
def test_nothing_shows_which_contacts_are_sealed_before_their_decision(make_console, user):
    """A fleet with sealed contacts, and one with the same contacts of vehicles."""
    consoles = [make_console(calibration_share=0.05) for _ in range(2)]
    clocks = [Clock(console) for console in consoles]
    earlier = FIRST_UTC_S - 86400.0
    for console, clock, truth in zip(consoles, clocks, (MINE, None), strict=True):
        add(console, "00A1", first_utc_s=earlier, position=(56.002, -5.0))
        for number in range(4):
            clock.advance(5.0)
            known = truth if number % 2 else None
            position = (56.0 + 0.002 * number, -5.0)
            add(console, f"00B{number}", known, first_utc_s=FIRST_UTC_S + 30.0 * number, position=position)
        add(console, "00C1", first_utc_s=FIRST_UTC_S + 86400.0, position=(56.002, -5.0))
        console.state.events.run = "run"
    assert outputs(consoles[0], user) == outputs(consoles[1], user)
    # A decision shows nothing as long as it can be taken back.
    for console, clock in zip(consoles, clocks, strict=True):
        anna, contact_id = console.browser("anna"), contact_ids(console.state)["00B1"]
        assert anna.decide(contact_id).status_code == 201
        clock.advance(console.state.config.take_back_s - 1.0)
        console.state.reveal()
        assert console.state.unsent_records() == []
    assert outputs(consoles[0], user) == outputs(consoles[1], user)
    for console, clock in zip(consoles, clocks, strict=True):
        decision = console.browser("anna").get("/api/decisions/last").json()["decision"]
        assert console.browser("anna").undo(contact_ids(console.state)["00B1"], decision["decision_id"]).is_success
        clock.advance(60.0)
        console.state.reveal()
        assert console.state.unsent_records() == []
    assert outputs(consoles[0], user) == outputs(consoles[1], user)


def test_object_is_revealed_after_the_take_back_time(console, clock):
    contact_id = add(console, "00A7", MINE)
    anna = console.browser("anna")
    assert anna.decide(contact_id).status_code == 201
    clock.now_utc_s += console.state.config.take_back_s - 0.1
    console.state.reveal()
    assert anna.contact(contact_id)["truth"] is None
    assert anna.get("/api/score").json()["operators"] == []
    clock.now_utc_s += 0.2
    last = console.state.events.last
    console.state.reveal()
    assert anna.contact(contact_id)["truth"] == {"is_mine_like": True, "label": "cylinder", "sealed": True}
    assert [event.name for event in console.state.events.events_after(last)] == ["contact"]
    assert set(contact_ids(console.state)) == set()
    assert console.state.counts().total == 0
    last = console.state.events.last
    console.state.reveal()
    assert console.state.events.last == last


def test_decision_that_was_taken_back_reveals_nothing(console, clock):
    contact_id = add(console, "00A7", MINE)
    anna = console.browser("anna")
    decision = anna.decide(contact_id).json()["decision"]
    clock.now_utc_s += 2.0
    assert anna.post(f"/api/contacts/{contact_id}/undo", {"decision_id": decision["decision_id"]}).status_code == 201
    clock.now_utc_s += 60.0
    console.state.reveal()
    assert anna.contact(contact_id)["truth"] is None
    assert anna.get("/api/score").json()["operators"] == []


def test_nothing_about_a_sealed_contact_is_sent(console, clock):
    sealed, real = add(console, "00A7", MINE), add(console, "00A8")
    anna = console.browser("anna")
    for contact_id in (sealed, real):
        assert anna.decide(contact_id).status_code == 201
        assert anna.post(f"/api/contacts/{contact_id}/requests", {"kind": "refine"}).status_code == 201
    clock.now_utc_s += 60.0
    assert {item.record.image_id for item in console.state.unsent_records()} == {"00A8"}
    for name in ("contacts.csv", "contacts.geojson"):
        body = anna.get(f"/api/export/{name}").text
        assert "00A8" in body
        assert "00A7" not in body


def test_score_by_operator_and_bytes(console, clock):
    mine, rock = add(console, "00A7", MINE, total=60), add(console, "00A8", ROCK, total=300)
    anna, bo, eva = (console.browser(name) for name in ("anna", "bo", "eva"))
    anna.decide(mine, verdict="mine_like", shown_s=4.0)
    bo.decide(mine, verdict="not_mine_like", shown_s=6.0)
    anna.decide(rock, verdict="mine_like", shown_s=2.0)
    clock.now_utc_s += 10.0
    console.state.reveal()
    clock.now_utc_s += 10.0
    # A decision after the reveal does not count.
    bo.decide(rock, verdict="not_mine_like")
    clock.now_utc_s += 10.0
    sheet = eva.get("/api/score").json()
    scores = {one["operator"]: one for one in sheet["operators"]}
    assert scores["anna"]["detected"]["share"] == 1.0
    assert scores["anna"]["false_alarms"]["share"] == 1.0
    assert scores["anna"]["median_shown_s"] == 3.0
    assert 2.0 in [entry["detail"].get("shown_s") for entry in anna.contact(rock)["audit"]]
    assert scores["bo"]["detected"]["share"] == 0.0
    assert scores["bo"]["decided"] == 1
    assert [(one["above_bytes"], one["up_to_bytes"]) for one in scores["anna"]["by_bytes"]] == [(32, 64), (256, 512)]
    assert {one["operator"] for one in anna.get("/api/score").json()["operators"]} == {"anna"}


def test_score_counts_no_withdrawn_decision(console, clock):
    ids = [
        add(console, f"00A{number}", Truth(is_mine_like=True, label="cylinder", sealed=False)) for number in range(3)
    ]
    anna, bo, eva = (console.browser(name) for name in ("anna", "bo", "eva"))
    clock.now_utc_s += 20.0
    anna.decide(ids[0], verdict="not_mine_like")
    anna.decide(ids[1], verdict="unsure")
    clock.now_utc_s += 20.0
    console.state.reveal()
    wrong = anna.contact(ids[0])["decisions"][0]["decision_id"]
    assert anna.undo(ids[0], wrong).status_code == 201
    # A verdict after the object was shown does not replace it.
    clock.now_utc_s += 1.0
    anna.decide(ids[0], verdict="mine_like")
    clock.now_utc_s += 60.0
    bo.decide(ids[1], verdict="mine_like")
    bo.decide(ids[2], verdict="unsure")
    bo.decide(ids[2], verdict="mine_like")
    sheet = eva.get("/api/score").json()
    [score] = sheet["operators"]
    assert (score["operator"], score["decided"], score["unsure"], score["detected"]["total"]) == ("anna", 1, 1, 1)
    assert [(one["name"][-4:], one["verdict"]) for one in sheet["decisions"]] == [("00A1", "unsure")]
    # The latest verdicts of the watch, of all operators; the time is that to the first verdict on a contact.
    assert anna.get("/api/score").json()["watch"] == [
        {
            "operator": "anna",
            "verdicts": {"unsure": 1, "mine_like": 1},
            "median_s": 30.5,
            "time_utc_s": FIRST_UTC_S + 41.0,
        },
        {"operator": "bo", "verdicts": {"mine_like": 2}, "median_s": 101.0, "time_utc_s": FIRST_UTC_S + 101.0},
    ]
