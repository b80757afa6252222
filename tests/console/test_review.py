"""From a picture's arrival to a decision: lists, versions, groups, two people at once, undo, audit."""

from __future__ import annotations

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import count

import pytest
from builders.console import FIRST_UTC_S, picture_record
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sonarpost.errors import DeliveryError
from sonarpost.messages import Advice, Decision, DownlinkState
from sonarpost.review.grouping import Place, nearest_group
from sonarpost.services.console.store.contacts import Filter
from sonarpost.services.console.store.database import OnScreen
from sonarpost.services.console.store.decisions import ConflictError, DecisionInput
from sonarpost.services.console.store.requests import is_news
from sonarpost.services.console.store.users import Actor

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"
SECONDS = count()


def test_a_contact_appears_refines_and_stays_one(console):
    watch = console.browser("watch")
    assert console.board.take_image(picture_record(missing_rows=30))
    [row] = watch.get("/api/contacts").json()["items"]
    assert (row["id"], row["version"], row["percent_received"], row["complete"]) == (ID, 1, 25.0, False)
    assert console.board.take_image(picture_record(version=2))
    assert not console.board.take_image(picture_record(version=2))
    whole = watch.get(f"/api/contacts/{ID}").json()
    assert [v["version"] for v in whole["versions"]] == [1, 2]
    assert whole["contact"]["complete"]
    assert whole["contact"]["percent_received"] == 100.0
    assert whole["record"]["altitude_m"] == 5.0
    assert whole["record"]["nadir_side"] == "left"


def test_an_older_version_that_comes_late_does_not_replace_the_newer(console):
    console.board.take_image(picture_record(version=3))
    console.board.take_image(picture_record(version=2, missing_rows=10))
    whole = console.browser("watch").get(f"/api/contacts/{ID}").json()
    assert whole["contact"]["version"] == 3
    assert [v["version"] for v in whole["versions"]] == [2, 3]


def test_lists_filter_sort_and_page(console):
    for number in range(25):
        console.board.take_image(
            picture_record(
                f"{number:04d}",
                vehicle=f"uuv-{number % 2 + 1}",
                atd_confidence=number / 20,
                place=(56 + number / 100, -5.0),
                missing_rows=10 * (number % 2),
            )
        )
    watch = console.browser("watch")
    first = watch.get("/api/contacts", sort="confidence", order="asc", limit=10).json()
    second = watch.get("/api/contacts", sort="confidence", order="asc", limit=10, offset=10).json()
    confidences = [row["atd_confidence"] for row in first["items"] + second["items"]]
    assert confidences == [number / 20 for number in range(20)]
    assert (first["total"], first["matching"], first["unreviewed"]) == (25, 25, 25)
    assert first["vehicles"] == ["uuv-1", "uuv-2"]
    found = watch.get("/api/contacts", vehicle="uuv-2", min_confidence="1.0", complete="false").json()
    assert {row["image_id"] for row in found["items"]} == {"0021", "0023"}
    assert found["matching"] == 2
    assert [row["image_id"] for row in watch.get("/api/contacts", q="0_").json()["items"]] == []
    assert watch.get("/api/contacts", q="/0007").json()["items"][0]["image_id"] == "0007"


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("sort", "id; DROP TABLE contact"),
        ("limit", "501"),
        ("limit", "1.5"),
        ("offset", "-1"),
        ("min_confidence", "nan"),
        ("review", "maybe"),
        ("order", "up"),
        ("q", "x" * 81),
    ],
)
def test_a_wrong_parameter_is_named(console, parameter, value):
    answer = console.browser("watch").get("/api/contacts", **{parameter: value})
    assert answer.status_code == 400
    assert answer.json()["error"]["field"] == parameter


def test_looks_at_one_object_are_grouped_and_neighbours_are_not(console):
    near, far = (56.0, -5.0), (56.001, -5.0)  # 111 m apart
    console.board.take_image(picture_record("0001", place=near))
    console.board.take_image(picture_record("0002", place=(56.00002, -5.0), vehicle="uuv-2"))
    console.board.take_image(picture_record("0003", place=far))
    console.board.take_image(picture_record("0004", place=None))
    watch = console.browser("watch")
    rows = {row["image_id"]: row for row in watch.get("/api/contacts").json()["items"]}
    assert rows["0001"]["group"] == rows["0002"]["group"] is not None
    assert (rows["0001"]["looks"], rows["0003"]["looks"], rows["0003"]["group"]) == (2, 1, None)
    whole = watch.get(f"/api/contacts/{rows['0001']['id']}").json()
    assert {row["image_id"] for row in whole["group"]} == {"0001", "0002"}


def test_what_a_vehicle_sees_on_one_pass_is_several_things_however_badly_it_knows_where():
    first = Place("g1", 56.0, -5.0, 7.0, "uuv-1", 1000.0)
    north_m = 1 / 111_320
    beside = Place("", 56.0 + 12 * north_m, -5.0, 7.0, "uuv-1", 1010.0)
    assert nearest_group(beside, [first], 8.0) is None
    assert nearest_group(replace(beside, seen_utc_s=1500.0), [first], 8.0) == "g1"
    assert nearest_group(replace(beside, vehicle_id="uuv-2"), [first], 8.0) == "g1"
    assert nearest_group(replace(beside, lat_deg=56.0 + north_m), [first], 8.0) == "g1"
    nearer = replace(first, group="g2", lat_deg=56.0 + 10 * north_m)
    assert nearest_group(replace(beside, seen_utc_s=1500.0), [first, nearer], 8.0) == "g2"
    far = replace(first, lat_deg=56.0 + 50 * north_m, sigma_m=500.0, seen_utc_s=None)
    assert nearest_group(beside, [far], 8.0) is None


def test_a_decision_is_kept_with_what_was_on_the_screen(console):
    console.board.take_image(picture_record())
    anna = console.browser("anna")
    answer = console.decide(anna, ID)
    assert answer.status_code == 201, answer.text
    assert answer.json()["contact"]["review"] == "mine_like"
    assert answer.json()["decision"]["delivery"]["shore"] == "waiting"
    whole = anna.get(f"/api/contacts/{ID}").json()
    [entry] = whole["audit"]
    assert (entry["user"], entry["action"], entry["version"]) == ("anna", "decide", 1)
    assert entry["sha256"] == whole["versions"][0]["sha256"]
    assert entry["detail"]["remark"] == "clean edge"
    [item] = console.board.unsent()
    assert isinstance(item.record, Decision)
    assert (item.record.verdict, item.record.operator, item.record.image_version) == ("mine_like", "anna", 1)


def test_of_two_people_at_once_the_second_is_told(console):
    console.board.take_image(picture_record())
    anna, bo = console.browser("anna"), console.browser("bo")
    assert console.decide(anna, ID, revision=0).status_code == 201
    answer = console.decide(bo, ID, revision=0, verdict="not_mine_like")
    assert answer.status_code == 409
    assert answer.json()["error"]["code"] == "conflict"
    assert answer.json()["decision"]["operator"] == "anna"
    again = console.decide(bo, ID, revision=answer.json()["contact"]["revision"], verdict="not_mine_like")
    assert again.status_code == 201
    decided = bo.get(f"/api/contacts/{ID}").json()["decisions"]
    assert [d["operator"] for d in decided] == ["bo", "anna"]


def test_of_many_at_the_same_moment_one_decides(console):
    console.board.take_image(picture_record())
    screen = OnScreen(1, console.board.image(ID, 1).picture_sha256, "raw")

    def decide(name: str) -> bool:
        try:
            console.board.decide(
                ID, DecisionInput(0, screen, "unsure", None, None, name), Actor(name, "operator", "here")
            )
        except ConflictError as error:
            return error.decision is None
        return True

    names = [f"op-{number}" for number in range(12)]
    with ThreadPoolExecutor(12) as pool:
        made = dict(zip(names, pool.map(decide, names), strict=True))
    [winner] = [name for name, decided in made.items() if decided]
    whole = console.browser("watch").get(f"/api/contacts/{ID}").json()
    assert [decision["operator"] for decision in whole["decisions"]] == [winner]
    assert (whole["contact"]["decided_by"], whole["contact"]["revision"]) == (winner, 1)


@given(
    st.lists(st.text(alphabet="ab%_\\'é", max_size=4), max_size=6), st.text(alphabet="ab%_\\'é", min_size=1, max_size=3)
)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_search_finds_what_has_the_text_and_nothing_else(console, remarks, wanted):
    with console.board.database.writing() as db:
        db.execute("DELETE FROM contact")
    for number, remark in enumerate(remarks):
        console.board.take_images([picture_record(f"{number:04d}", first_utc_s=FIRST_UTC_S + next(SECONDS))])
        with console.board.database.writing() as db:
            db.execute("UPDATE contact SET remark = ? WHERE image_id = ?", (remark, f"{number:04d}"))
    found = console.board.contacts(Filter(text=wanted))["items"]
    # Upper and lower case of ASCII are one, and of other letters two, as SQLite has it.
    expected = {f"{number:04d}" for number, remark in enumerate(remarks) if wanted in remark or wanted in "uuv-1/"}
    assert {row["image_id"] for row in found} == expected


def test_a_refined_picture_is_no_conflict(console):
    console.board.take_image(picture_record())
    console.board.take_image(picture_record(version=2))
    assert console.decide(console.browser("anna"), ID, revision=0).status_code == 201


def test_undo_is_a_record_more_and_puts_back_what_was(console):
    console.board.take_image(picture_record())
    anna = console.browser("anna")
    first = console.decide(anna, ID).json()["decision"]
    second = console.decide(anna, ID, verdict="unsure").json()
    path = f"/api/contacts/{ID}/undo"
    stale = anna.post(path, {"revision": 1, "decision_id": second["decision"]["decision_id"]})
    assert stale.status_code == 409
    wrong = anna.post(path, {"revision": 2, "decision_id": first["decision_id"]})
    assert (wrong.status_code, wrong.json()["error"]["field"]) == (400, "decision_id")
    back = anna.post(path, {"revision": 2, "decision_id": second["decision"]["decision_id"]}).json()
    assert back["contact"]["review"] == "mine_like"
    assert back["decision"]["undoes"] == second["decision"]["decision_id"]
    none = anna.post(path, {"revision": 3, "decision_id": first["decision_id"]}).json()
    assert (none["contact"]["review"], none["decision"]["verdict"]) == ("unreviewed", "unsure")
    whole = anna.get(f"/api/contacts/{ID}").json()
    assert len(whole["decisions"]) == len(whole["audit"]) == len(console.board.unsent()) == 4


def test_a_decision_on_another_picture_is_refused(console):
    console.board.take_image(picture_record())
    anna = console.browser("anna")
    assert console.decide(anna, ID, sha256="0" * 64).json()["error"]["field"] == "sha256"
    assert console.decide(anna, ID, version=2).json()["error"]["field"] == "version"
    assert console.board.unsent() == []


def test_the_audit_cannot_be_changed(console):
    console.board.take_image(picture_record())
    console.decide(console.browser("anna"), ID)
    for change in ("UPDATE audit SET user = 'bo'", "DELETE FROM audit"):
        with pytest.raises(DeliveryError, match="only added to"), console.board.database.writing() as db:
            db.execute(change)
    with console.board.database.reading() as db, pytest.raises(sqlite3.Error, match="only added to"):
        db.execute("DELETE FROM audit")


def test_a_decision_comes_ashore_and_to_the_vehicle(console):
    console.board.take_image(picture_record())
    anna = console.browser("anna")
    decision_id = console.decide(anna, ID).json()["decision"]["decision_id"]

    def delivery():
        return anna.get(f"/api/contacts/{ID}").json()["contact"]["delivery"]

    console.board.settled("decision", decision_id, "relay", None)
    console.board.settled("decision", decision_id, "op_modem", None)
    assert (delivery()["shore"], delivery()["vehicle"]) == ("relay", "asked")
    now = console.board.clock()
    # By the clock of a modem's host that is behind.
    for number, state in enumerate(("asked", "sent", "confirmed", "sent"), start=-100):
        console.board.take_downlink(
            DownlinkState(
                vessel_id="vessel-1",
                vehicle_id="uuv-1",
                kind="decision",
                record_id=decision_id,
                state=state,
                times_sent=1,
                expires_utc_s=now + 100,
                changed_utc_s=now + number,
            )
        )
    assert delivery()["vehicle"] == "confirmed"
    console.board.all_ashore_before(now - 60)
    assert delivery()["shore"] == "relay"
    console.board.all_ashore_before(now + 60)
    assert delivery()["shore"] == "delivered"


def test_a_state_is_news_when_it_is_farther_on():
    states = ("waiting", "asked", "sent", "confirmed")
    for place, was in enumerate(states):
        assert [is_news(was, 1, state, 1) for state in states] == [later > place for later in range(4)]
    assert is_news("sent", 1, "sent", 2)
    assert not is_news("sent", 2, "sent", 1)
    assert not is_news("expired", 1, "confirmed", 1)


def test_a_refused_decision_says_why(console):
    console.board.take_image(picture_record())
    anna = console.browser("anna")
    decision_id = console.decide(anna, ID).json()["decision"]["decision_id"]
    console.board.settled("decision", decision_id, "op_modem", "no such vehicle")
    delivery = anna.get(f"/api/contacts/{ID}").json()["contact"]["delivery"]
    assert (delivery["vehicle"], delivery["reason"], delivery["shore"]) == ("refused", "no such vehicle", "waiting")


def test_what_came_before_its_picture_waits_for_it(make_console):
    console = make_console(role="shore")
    at = FIRST_UTC_S + 50
    names = {"vessel_id": "vessel-1", "vehicle_id": "uuv-1", "image_id": "00A7", "image_version": 1}
    decision = Decision(decision_id="d-1", verdict="mine_like", operator="anna", decided_utc_s=at, **names)
    assert console.board.take_decision(decision)
    assert not console.board.take_decision(decision)
    console.board.take_advice(Advice(advice_id="a-1", author="eva", advised_utc_s=at, remark="look again", **names))
    console.board.take_image(picture_record())
    whole = console.browser("watch").get(f"/api/contacts/{ID}").json()
    assert whole["contact"]["review"] == "mine_like"
    assert whole["contact"]["advised"]
    assert [d["elsewhere"] for d in whole["decisions"]] == [True]
    assert [a["remark"] for a in whole["advice"]] == ["look again"]


def test_requests_cost_what_they_cost_and_are_not_doubled(make_console):
    console = make_console(assumed_rate=1)
    console.board.take_image(picture_record(missing_rows=30))
    anna = console.browser("anna")
    costs = {cost["kind"]: cost for cost in anna.get(f"/api/contacts/{ID}/costs").json()["costs"]}
    # 150 of 200 bytes lack: 3 frames of 64 bytes, one packet of 6.1 s, after one of 3.2 s down.
    assert (costs["resend"]["bytes"], costs["resend"]["packets"]) == (150, 1)
    assert costs["resend"]["airtime_s"] == pytest.approx(9.3)
    # Twice the stream: 350 bytes lack, 7 frames, three packets.
    assert (costs["refine"]["bytes"], costs["refine"]["packets"]) == (350, 3)
    assert costs["revisit"]["airtime_s"] == pytest.approx(3.2)
    # A picture of its own, of 200 bytes: 4 frames, two packets.
    assert (costs["wider"]["bytes"], costs["wider"]["packets"]) == (200, 2)
    assert costs["wider"]["airtime_s"] == pytest.approx(3.2 + 2 * 6.1)
    assert costs["wider"]["basis"] == "rate 1 as heard last, a new picture of 200 bytes"
    path = f"/api/contacts/{ID}/requests"
    asked = anna.post(path, {"kind": "resend", "airtime_s": 9.3})
    assert (asked.status_code, asked.json()["state"]) == (201, "waiting")
    assert anna.post(path, {"kind": "resend"}).status_code == 400
    console.board.settled("request", asked.json()["command_id"], "op_modem", "it only listens")
    [request] = anna.get(f"/api/contacts/{ID}").json()["requests"]
    assert (request["state"], request["reason"]) == ("refused", "it only listens")
    assert anna.post(path, {"kind": "resend"}).status_code == 201
    assert anna.post(path, {"kind": "wider"}).status_code == 201
    assert anna.post(path, {"kind": "larger"}).status_code == 400


def test_a_wider_picture_costs_what_this_one_did_before_it_was_refined(make_console):
    console = make_console(assumed_rate=1)
    console.board.take_image(picture_record())
    console.board.take_image(picture_record(version=2).model_copy(update={"bytes_received": 400, "bytes_total": 400}))
    costs = {cost["kind"]: cost for cost in console.browser("anna").get(f"/api/contacts/{ID}/costs").json()["costs"]}
    assert (costs["refine"]["bytes"], costs["wider"]["bytes"]) == (400, 200)


def test_a_cost_that_cannot_be_told_is_not_invented(console):
    console.board.take_image(picture_record(missing_rows=30))
    costs = console.browser("anna").get(f"/api/contacts/{ID}/costs").json()["costs"]
    assert [c["airtime_s"] for c in costs if c["kind"] == "refine"] == [None]


@pytest.mark.parametrize(
    ("changes", "possible"),
    [
        ({}, {"refine", "revisit", "wider"}),
        ({"place": None}, {"refine", "wider"}),
        ({"place": None, "codec": "vq"}, {"wider"}),
        ({"missing_rows": 10, "codec": "vq"}, {"resend", "revisit", "wider"}),
        ({"missing_rows": 10}, {"refine", "resend", "revisit", "wider"}),
    ],
)
def test_what_leads_to_nothing_is_not_asked(console, changes, possible):
    rest = {name: value for name, value in changes.items() if name != "codec"}
    image = picture_record(**rest)
    console.board.take_image(image.model_copy(update={"codec": changes.get("codec", "emb")}))
    anna = console.browser("anna")
    costs = anna.get(f"/api/contacts/{ID}/costs").json()["costs"]
    assert {cost["kind"] for cost in costs if cost["available"]} == possible
    assert all(cost["reason"] for cost in costs if not cost["available"])
    for kind in ("refine", "resend", "revisit", "wider"):
        answer = anna.post(f"/api/contacts/{ID}/requests", {"kind": kind})
        assert answer.status_code == (201 if kind in possible else 400)
    assert len(console.board.unsent()) == len(possible)


def test_ashore_experts_advise_and_nobody_decides(make_console):
    console = make_console(role="shore")
    console.board.take_image(picture_record())
    eva, anna = console.browser("eva"), console.browser("anna")
    assert console.decide(eva, ID).status_code == 403
    body = {"version": 1, "verdict": "unsure", "confidence": None, "mlo_class": None, "remark": "shadow too long"}
    assert anna.post(f"/api/contacts/{ID}/advice", body).status_code == 403
    answer = eva.post(f"/api/contacts/{ID}/advice", body)
    assert answer.status_code == 201
    assert answer.json()["delivery"] == {"state": "waiting", "reason": ""}
    [item] = console.board.unsent()
    console.board.mark_sent(item)
    assert (item.vessel_id, console.board.unsent()) == ("vessel-1", [])
