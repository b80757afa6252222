"""Results of requests, what a vehicle cannot do, and images that answer requests as layers of their contact."""

from __future__ import annotations

import sqlite3

import pytest
from builders.console import FIRST_UTC_S, image_record

from sonarpost.messages import DownlinkState
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.store.requests import REFUSAL_VALID_S

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def preview(image_id="00A7", version=1, received=30, *, complete=False, total=0, **fields):
    record = image_record(image_id, version, **fields)
    changes = {"complete": complete, "bytes_received": received, "bytes_total": received if complete else total}
    return record.model_copy(update={**changes, "despeckle_strength": 1.0})


def related(kind, version=1, *, complete=True, received=300, **fields):
    """The image that answers a request about contact 00A7."""
    scale = 2.02 if kind == "wider" else 1.0  # the link transmits pixel sizes in steps of 2.5 %
    sizes = {"pixel_along_m": 0.1 * scale, "pixel_across_m": 0.05 * scale, **fields}
    record = preview("00A9", version, received, complete=complete, first_utc_s=FIRST_UTC_S + 60, **sizes)
    return record.model_copy(
        update={
            "contact": record.contact.model_copy(update={"time_utc_s": FIRST_UTC_S - 100}),
            "despeckle_strength": 1.0 if kind == "wider" else 0.0,
        }
    )


def ask(console, kind="refine", contact_id=ID, status=201):
    answer = console.browser("anna").post(f"/api/contacts/{contact_id}/requests", {"kind": kind, "airtime_s": 12.0})
    assert answer.status_code == status, answer.text
    return answer.json()


def requests_of(console, contact_id=ID):
    return console.browser("watch").contact(contact_id)["requests"]


def downlink(console, request, state, reason=""):
    console.state.apply_downlink_state(
        DownlinkState(
            vessel_id="vessel-1",
            vehicle_id="uuv-1",
            kind=request["kind"],
            record_id=request["command_id"],
            state=state,
            times_sent=1,
            expires_utc_s=console.state.clock() + 3600.0,
            changed_utc_s=console.state.clock(),
            reason=reason,
        )
    )


def costs(console, contact_id=ID):
    return {cost["kind"]: cost for cost in console.browser("anna").contact(contact_id)["costs"]}


def test_costs_come_with_the_contact(console):
    console.state.store_image(preview(received=200, complete=True))
    anna = console.browser("anna")
    assert anna.contact(ID)["costs"] == anna.get(f"/api/contacts/{ID}/costs").json()["costs"]


def test_refine_request_is_answered_by_the_complete_longer_stream(console):
    console.state.store_image(preview(received=200, complete=True))
    request = ask(console)
    downlink(console, request, "confirmed")
    console.state.store_image(preview(version=2, received=260))
    [arriving] = requests_of(console)
    assert (arriving["arrived_utc_s"], arriving["result"]) == (None, {"id": ID, "version": 2, "bytes": 60})
    console.state.store_image(preview(version=3, received=400, complete=True))
    [arrived] = requests_of(console)
    assert arrived["arrived_utc_s"] is not None
    assert arrived["result"] == {"id": ID, "version": 3, "bytes": 200}
    assert console.browser("watch").contact(ID)["contact"]["open_requests"] == 0
    console.state.store_image(preview(version=4, received=800, complete=True))
    assert requests_of(console)[0] == arrived


def test_bytes_announced_before_the_refine_request_do_not_answer_it(console):
    console.state.store_image(preview(received=60, total=131))
    ask(console)
    console.state.store_image(preview(version=2, received=131, complete=True))
    assert requests_of(console)[0]["arrived_utc_s"] is None


def test_resend_request_is_answered_by_the_complete_image(console):
    console.state.store_image(preview(received=100, total=200))
    ask(console, "resend")
    console.state.store_image(preview(version=2, received=200, complete=True))
    assert requests_of(console)[0]["result"] == {"id": ID, "version": 2, "bytes": 100}


def test_revisit_request_is_answered_by_a_later_look_of_the_vehicle(console):
    now = FIRST_UTC_S + 1000.0
    console.state.clock = lambda: now
    console.state.store_image(preview(received=200, complete=True))
    ask(console, "revisit")
    console.state.store_image(image_record("00B1", vehicle="uuv-2", first_utc_s=now + 500))
    assert requests_of(console)[0]["arrived_utc_s"] is None
    console.state.store_image(image_record("00B2", first_utc_s=now + 500))
    assert requests_of(console)[0]["result"]["id"].endswith(".00B2")


@pytest.mark.parametrize("kind", ["wider", "original"])
def test_answer_to_a_request_is_a_layer_of_its_contact(kind, console):
    console.state.store_image(preview(received=200, complete=True))
    ask(console, kind)
    console.state.store_image(related(kind, complete=False, received=30))
    console.state.store_image(related(kind, 2))
    watch = console.browser("watch")
    listed = watch.get("/api/contacts").json()
    assert (listed["total"], listed["unreviewed"], listed["matching"]) == (1, 1, 1)
    assert [row["id"] for row in listed["items"]] == [ID]
    assert [one["id"] for one in watch.get("/api/map").json()["contacts"]] == [ID]
    assert watch.get("/api/export/contacts.geojson").text.count('"Feature"') == 1
    detail = watch.contact(ID)
    [layer] = detail["related"]
    assert (layer["relation"], [one["version"] for one in layer["versions"]]) == (kind, [1, 2])
    assert watch.get(f"/api/contacts/{layer['id']}/versions/2/picture.png").status_code == 200
    [request] = detail["requests"]
    assert request["result"] == {"id": layer["id"], "version": 2, "bytes": 300}
    assert request["arrived_utc_s"] is not None
    assert costs(console)[kind]["reason_code"] == "here"


def test_layer_that_arrives_before_its_contact_is_linked(console):
    console.state.store_image(related("wider"))
    assert console.state.counts().total == 1
    console.state.store_image(preview(received=200, complete=True))
    listed = console.browser("watch").get("/api/contacts").json()
    assert [row["id"] for row in listed["items"]] == [ID]


@pytest.mark.parametrize(
    "changes",
    [
        {"position": (56.0001, -5.0)},
        {"altitude_m": 5.5},
        {"pixel_across_m": 0.05},
        {"vehicle": "uuv-2"},
    ],
)
def test_other_detections_stay_contacts(changes, console):
    console.state.store_image(preview(received=200, complete=True))
    console.state.store_image(related("wider", **changes))
    assert console.state.counts().total == 2


def test_same_image_with_another_identifier_stays_a_contact(console):
    """A vehicle that has lost its state can send a contact twice: nothing shows that a request was answered."""
    console.state.store_image(preview(received=200, complete=True))
    again = related("original").model_copy(update={"despeckle_strength": 1.0})
    console.state.store_image(again)
    assert console.state.counts().total == 2


def test_image_with_a_decision_stays_a_contact(console):
    console.state.store_image(related("wider"))
    [row] = console.browser("watch").get("/api/contacts").json()["items"]
    assert console.browser("anna").decide(row["id"]).status_code == 201
    console.state.store_image(preview(received=200, complete=True))
    assert console.state.counts().total == 2


def test_vehicle_without_a_consumer_is_remembered(console):
    now = FIRST_UTC_S
    console.state.clock = lambda: now
    console.state.store_image(preview(received=200, complete=True))
    console.state.store_image(image_record("00B2", position=(57.0, -5.0)))
    other = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00B2"
    downlink(console, ask(console, "revisit"), "refused", "unsupported")
    found = costs(console, other)["revisit"]
    assert (found["available"], found["reason_code"], found["reason"]) == (
        False,
        "unsupported",
        "uuv-1 cannot do this",
    )
    assert costs(console, other)["refine"]["available"]
    ask(console, "revisit", other, 400)
    now += REFUSAL_VALID_S + 1.0
    assert costs(console, other)["revisit"]["available"]


def test_other_refusals_do_not_exclude_a_kind(console):
    console.state.store_image(preview(received=200, complete=True))
    downlink(console, ask(console), "refused", "unknown image")
    assert costs(console)["refine"]["available"]


def test_vessel_without_downlink_offers_no_requests(make_console):
    console = make_console(command_consumers=())
    console.state.store_image(preview(received=200, complete=True))
    assert {cost["reason_code"] for cost in costs(console).values()} == {"no_downlink"}
    ask(console, status=400)


def test_pending_request_excludes_another_of_its_kind_until_it_is_late(console):
    now = FIRST_UTC_S
    console.state.clock = lambda: now
    console.state.store_image(preview(received=200, complete=True))
    request = ask(console)
    downlink(console, request, "confirmed")
    ask(console, status=400)
    now = requests_of(console)[0]["late_utc_s"] + 1.0
    ask(console)


def test_expected_time_follows_the_durations_of_earlier_requests(make_console):
    console = make_console(assumed_rate=1)
    now = FIRST_UTC_S
    console.state.clock = lambda: now
    console.state.store_image(preview(received=200, complete=True))
    first = ask(console)
    airtime_s = costs(console)["refine"]["airtime_s"]
    assert first["expected_utc_s"] is None
    assert first["earliest_utc_s"] == pytest.approx(now + airtime_s)
    # The displayed air time of the request is 12 s; it was answered after ten times this.
    now += 120.0
    console.state.store_image(preview(version=2, received=400, complete=True))
    second = ask(console)
    airtime_s = second["earliest_utc_s"] - now
    assert second["expected_utc_s"] == pytest.approx(now + 10 * airtime_s)
    assert second["late_utc_s"] > second["expected_utc_s"]


def test_database_of_an_earlier_version_opens(tmp_path):
    path = tmp_path / "console-review.db"
    Database(path).close()
    with sqlite3.connect(path) as db:
        for index in ("contact_answers", "contact_listed"):
            db.execute(f"DROP INDEX {index}")
        for table, column in (("contact", "parent"), ("contact", "relation"), ("request", "result_bytes")):
            db.execute(f"ALTER TABLE {table} DROP COLUMN {column}")
    database = Database(path)
    with database.read() as db:
        assert {"parent", "relation"} <= {row["name"] for row in db.execute("PRAGMA table_info(contact)")}
        assert "result_bytes" in {row["name"] for row in db.execute("PRAGMA table_info(request)")}
    database.close()
