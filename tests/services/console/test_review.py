"""Contact lists, image versions, groups, decisions, undo, audit, requests and comments."""

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import pytest
from builders.console import FIRST_UTC_S, comment_record, contact_id, downlink_state, image_record
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import DeliveryError
from sonarpost.messages import Decision
from sonarpost.services.console.store.contacts import ContactFilter
from sonarpost.services.console.store.database import Actor, DisplayedImage
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.store.requests import REQUEST_KINDS, is_later_state

ID = contact_id()
SECONDS = count()


def test_image_versions_belong_to_one_contact(console):
    watch = console.browser("watch")
    assert console.state.store_image(image_record(missing_rows=30))
    [row] = watch.get("/api/contacts").json()["items"]
    assert (row["id"], row["version"], row["percent_received"], row["complete"]) == (ID, 1, 25.0, False)
    assert console.state.store_image(image_record(version=2))
    assert not console.state.store_image(image_record(version=2))
    detail = watch.contact(ID)
    assert [v["version"] for v in detail["versions"]] == [1, 2]
    assert detail["contact"]["complete"]
    assert detail["contact"]["percent_received"] == 100.0
    assert detail["record"]["altitude_m"] == 5.0
    # A late older version does not replace the newer one.
    console.state.store_image(image_record(version=4))
    console.state.store_image(image_record(version=3, missing_rows=10))
    detail = watch.contact(ID)
    assert detail["contact"]["version"] == 4
    assert [v["version"] for v in detail["versions"]] == [1, 2, 3, 4]


def test_list_filter_sort_and_pages(console):
    for number in range(25):
        changes = {"vehicle": f"uuv-{number % 2 + 1}", "missing_rows": 10 * (number % 2)}
        place = {"position": (56 + number / 100, -5.0), "atd_confidence": number / 20}
        console.state.store_image(image_record(f"{number:04d}", first_utc_s=1000.0 + number, **changes, **place))
    watch = console.browser("watch")
    first = watch.get("/api/contacts", sort="confidence", order="asc", limit=10).json()
    second = watch.get("/api/contacts", sort="confidence", order="asc", limit=10, offset=10).json()
    confidences = [row["atd_confidence"] for row in first["items"] + second["items"]]
    assert confidences == [number / 20 for number in range(20)]
    assert (first["total"], first["matching"], first["to_do"]) == (25, 25, 25)
    assert first["vehicles"] == ["uuv-1", "uuv-2"]
    found = watch.get("/api/contacts", vehicle="uuv-2", from_utc_s="1020").json()
    assert {row["image_id"] for row in found["items"]} == {"0021", "0023"}
    assert found["matching"] == 2
    found = watch.get("/api/contacts", from_utc_s="1003", to_utc_s="1006").json()
    assert {row["image_id"] for row in found["items"]} == {"0003", "0004", "0005"}
    assert [row["image_id"] for row in watch.get("/api/contacts", q="0_").json()["items"]] == []
    assert watch.get("/api/contacts", q="/0007").json()["items"][0]["image_id"] == "0007"


def test_error_names_the_invalid_parameter(console):
    watch = console.browser("watch")
    for parameter, value in (
        ("sort", "id; DROP TABLE contact"),
        ("limit", "501"),
        ("limit", "1.5"),
        ("offset", "-1"),
        ("from_utc_s", "-1"),
        ("to_utc_s", "inf"),
        ("review", "maybe"),
        ("order", "up"),
        ("q", "x" * 81),
    ):
        answer = watch.get("/api/contacts", **{parameter: value})
        assert (answer.status_code, answer.json()["error"]["field"]) == (400, parameter)


def test_looks_at_one_object_are_grouped(console):
    near, far = (56.0, -5.0), (56.001, -5.0)  # 111 m apart
    console.state.store_image(image_record("0001", position=near))
    console.state.store_image(image_record("0002", position=(56.00002, -5.0), vehicle="uuv-2"))
    console.state.store_image(image_record("0003", position=far))
    console.state.store_image(image_record("0004", position=None))
    watch = console.browser("watch")
    rows = {row["image_id"]: row for row in watch.get("/api/contacts").json()["items"]}
    assert rows["0001"]["object"] == rows["0002"]["object"] != rows["0003"]["object"] is not None
    assert [rows[name]["looks"] for name in ("0001", "0002", "0003", "0004")] == [2, 2, 1, 1]
    assert rows["0004"]["object"] is None
    detail = watch.get(f"/api/contacts/{rows['0001']['id']}").json()
    assert {row["image_id"] for row in detail["group"]} == {"0001", "0002"}


def test_decision_is_stored_with_the_displayed_image(make_console):
    console = make_console(take_back_s=0)
    console.state.store_image(image_record())
    anna = console.browser("anna")
    answer = anna.decide(ID)
    assert answer.status_code == 201, answer.text
    assert answer.json()["contact"]["review"] == "mine_like"
    assert answer.json()["decision"]["delivery"]["shore"] == "waiting"
    detail = anna.contact(ID)
    [entry] = detail["audit"]
    assert (entry["user"], entry["action"], entry["version"]) == ("anna", "decide", 1)
    assert entry["sha256"] == detail["versions"][0]["sha256"]
    assert entry["detail"]["remark"] == "clean edge"
    [item] = console.state.unsent_records()
    assert isinstance(item.record, Decision)
    assert (item.record.verdict, item.record.operator, item.record.image_version) == ("mine_like", "anna", 1)
    console.state.mark_sent(item)
    # A decision on another image is rejected; a new version of the image is no conflict.
    assert anna.decide(ID, sha256="0" * 64).json()["error"]["field"] == "sha256"
    assert anna.decide(ID, version=2).json()["error"]["field"] == "version"
    assert console.state.unsent_records() == []
    revision = anna.contact(ID)["contact"]["revision"]
    console.state.store_image(image_record(version=2))
    assert anna.decide(ID, revision=revision).status_code == 201
    # A refused decision has a reason.
    decision_id = anna.contact(ID)["decisions"][0]["decision_id"]
    console.state.apply_acknowledgement("decision", decision_id, "op_modem", "no such vehicle")
    delivery = anna.contact(ID)["contact"]["delivery"]
    assert (delivery["vehicle"], delivery["reason"], delivery["shore"]) == ("refused", "no such vehicle", "waiting")


def test_simultaneous_decisions_of_several_operators_are_all_stored(console):
    console.state.store_image(image_record())
    displayed = DisplayedImage(1, console.state.image(ID, 1).pixels_sha256, "raw")

    def decide(name: str) -> None:
        verdict = "mine_like" if name == "op-3" else "not_mine_like"
        console.state.decide(
            ID, DecisionInput(0, displayed, verdict, None, None, name), Actor(name, "operator", "127.0.0.1")
        )

    names = [f"op-{number}" for number in range(12)]
    with ThreadPoolExecutor(12) as pool:
        list(pool.map(decide, names))
    detail = console.browser("watch").contact(ID)
    assert sorted(decision["operator"] for decision in detail["decisions"]) == sorted(names)
    contact = detail["contact"]
    assert (contact["review"], contact["decided_by"], contact["revision"]) == ("disputed", "op-3", 12)


@given(
    st.lists(st.text(alphabet="ab%_\\'é", max_size=4), max_size=6), st.text(alphabet="ab%_\\'é", min_size=1, max_size=3)
)
def test_search_finds_exactly_the_contacts_with_the_text(console, remarks, text):
    with console.state.database.transaction() as db:
        db.execute("DELETE FROM contact")
    for number, remark in enumerate(remarks):
        console.state.store_images([image_record(f"{number:04d}", first_utc_s=FIRST_UTC_S + next(SECONDS))])
        with console.state.database.transaction() as db:
            db.execute("UPDATE contact SET remark = ? WHERE image_id = ?", (remark, f"{number:04d}"))
    found = console.state.list_contacts(ContactFilter(text=text))["items"]
    # SQLite ignores the case of ASCII letters only.
    expected = {f"{number:04d}" for number, remark in enumerate(remarks) if text in remark or text in "uuv-1/"}
    assert {row["image_id"] for row in found} == expected


def test_audit_is_append_only(console):
    console.state.store_image(image_record())
    console.browser("anna").decide(ID)
    for change in ("UPDATE audit SET user = 'bo'", "DELETE FROM audit"):
        with pytest.raises(DeliveryError, match="only added to"), console.state.database.transaction() as db:
            db.execute(change)
    with console.state.database.read() as db, pytest.raises(sqlite3.Error, match="only added to"):
        db.execute("DELETE FROM audit")


def test_delivery_of_a_decision_to_shore_and_vehicle(console):
    console.state.store_image(image_record())
    anna = console.browser("anna")
    decision_id = anna.decide(ID).json()["decision"]["decision_id"]

    def delivery():
        return anna.contact(ID)["contact"]["delivery"]

    console.state.apply_acknowledgement("decision", decision_id, "relay", None)
    console.state.apply_acknowledgement("decision", decision_id, "op_modem", None)
    assert (delivery()["shore"], delivery()["vehicle"]) == ("relay", "asked")
    now = console.state.clock()
    # The clock of the modem's host is slow.
    for number, state in enumerate(("asked", "sent", "confirmed", "sent"), start=-100):
        console.state.apply_downlink_state(downlink_state("decision", decision_id, state, now + number))
    assert delivery()["vehicle"] == "confirmed"
    console.state.mark_delivered_to_shore(now - 60)
    assert delivery()["shore"] == "relay"
    console.state.mark_delivered_to_shore(now + 60)
    assert delivery()["shore"] == "delivered"


def test_order_of_delivery_states():
    states = ("waiting", "asked", "sent", "confirmed")
    for index, known in enumerate(states):
        assert [is_later_state(known, 1, state, 1) for state in states] == [later > index for later in range(4)]
    assert is_later_state("sent", 1, "sent", 2)
    assert not is_later_state("sent", 2, "sent", 1)
    assert not is_later_state("expired", 1, "confirmed", 1)


def test_records_before_their_image_are_attached_to_it(make_console):
    console = make_console(role="shore")
    at = FIRST_UTC_S + 50
    names = {"vessel_id": "vessel-1", "vehicle_id": "uuv-1", "image_id": "00A7", "image_version": 1}
    decision = Decision(decision_id="d-1", verdict="mine_like", operator="anna", decided_utc_s=at, **names)
    assert console.state.store_decision(decision)
    assert not console.state.store_decision(decision)
    console.state.store_comment(comment_record())
    console.state.store_image(image_record())
    detail = console.browser("watch").contact(ID)
    assert detail["contact"]["review"] == "mine_like"
    assert detail["contact"]["commented"]
    assert [d["elsewhere"] for d in detail["decisions"]] == [True]
    assert [a["remark"] for a in detail["comments"]] == ["look again"]


def test_request_costs_and_no_repeated_request(make_console):
    console = make_console(assumed_rate=1)
    console.state.store_image(image_record(missing_rows=30).model_copy(update={"despeckle_strength": 1.0}))
    anna = console.browser("anna")
    costs = {cost["kind"]: cost for cost in anna.contact(ID)["costs"]}
    # 150 of 200 bytes are missing: 3 frames of 64 bytes, one packet of 6.1 s, after one of 3.2 s down.
    assert costs["resend"]["bytes"] == 150
    assert costs["resend"]["airtime_s"] == pytest.approx(9.3)
    # Twice the stream: 350 bytes are missing, 7 frames, three packets.
    assert costs["refine"]["bytes"] == 350
    assert costs["refine"]["airtime_s"] == pytest.approx(3.2 + 3 * 6.1)
    assert costs["revisit"]["airtime_s"] == pytest.approx(3.2)
    # A new image of 200 bytes: 4 frames, two packets.
    assert costs["expand"]["bytes"] == 200
    assert costs["expand"]["airtime_s"] == pytest.approx(3.2 + 2 * 6.1)
    assert {**costs["original"], "kind": "expand"} == costs["expand"]
    path = f"/api/contacts/{ID}/requests"
    asked = anna.post(path, {"kind": "resend", "airtime_s": 9.3})
    assert (asked.status_code, asked.json()["state"]) == (201, "waiting")
    assert anna.post(path, {"kind": "resend"}).status_code == 400
    console.state.apply_acknowledgement("request", asked.json()["command_id"], "op_modem", "no transmitter")
    [request] = anna.contact(ID)["requests"]
    assert (request["state"], request["reason"]) == ("refused", "no transmitter")
    assert anna.post(path, {"kind": "resend"}).status_code == 201
    assert anna.post(path, {"kind": "expand"}).status_code == 201
    assert anna.post(path, {"kind": "original"}).status_code == 201
    assert anna.post(path, {"kind": "original"}).status_code == 400
    assert anna.post(path, {"kind": "larger"}).status_code == 400


def test_costs_of_new_images_are_those_of_the_first_version_and_unknown_without_a_rate(make_console):
    for rate in (1, None):
        console = make_console(assumed_rate=rate)
        console.state.store_image(image_record())
        longer = {"bytes_received": 400, "bytes_total": 400, "despeckle_strength": 1.0}
        console.state.store_image(image_record(version=2).model_copy(update=longer))
        costs = {cost["kind"]: cost for cost in console.browser("anna").contact(ID)["costs"]}
        assert [costs[kind]["bytes"] for kind in ("refine", "expand", "original")] == [400, 200, 200]
        assert [costs["refine"][name] is None for name in ("airtime_s", "median_s", "most_s")] == [rate is None] * 3


@pytest.mark.parametrize(
    ("changes", "possible"),
    [
        ({}, {"refine", "revisit", "expand"}),
        ({"position": None}, {"refine", "expand"}),
        ({"position": None, "codec": "vq"}, {"expand"}),
        ({"missing_rows": 10, "codec": "vq"}, {"resend", "prioritise", "revisit", "expand"}),
        ({"missing_rows": 10}, {"refine", "resend", "prioritise", "revisit", "expand"}),
        ({"despeckle_strength": 0.0}, {"refine", "revisit", "expand"}),
        ({"despeckle_strength": 0.0625}, {"refine", "revisit", "expand", "original"}),
    ],
)
def test_impossible_requests_are_rejected(console, changes, possible):
    of_codec = {name: value for name, value in changes.items() if name in ("codec", "despeckle_strength")}
    image = image_record(**{name: value for name, value in changes.items() if name not in of_codec})
    console.state.store_image(image.model_copy(update=of_codec))
    anna = console.browser("anna")
    costs = anna.contact(ID)["costs"]
    assert {cost["kind"] for cost in costs if cost["reason_code"] is None} - {"region"} == possible
    for kind in REQUEST_KINDS:
        answer = anna.post(f"/api/contacts/{ID}/requests", {"kind": kind})
        assert answer.status_code == (201 if kind in possible else 400)
    assert len(console.state.unsent_records()) == len(possible)


def test_at_the_shore_site_experts_comment_and_no_role_decides(make_console):
    console = make_console(role="shore")
    console.state.store_image(image_record())
    eva, anna = console.browser("eva"), console.browser("anna")
    assert eva.decide(ID).status_code == 403
    body = {"version": 1, "verdict": "unsure", "confidence": None, "mlo_class": None, "remark": "shadow too long"}
    assert anna.post(f"/api/contacts/{ID}/comment", body).status_code == 403
    answer = eva.post(f"/api/contacts/{ID}/comment", body)
    assert answer.status_code == 201
    assert answer.json()["delivery"] == {"state": "waiting", "reason": ""}
    [item] = console.state.unsent_records()
    console.state.mark_sent(item)
    assert (item.vessel_id, console.state.unsent_records()) == ("vessel-1", [])
