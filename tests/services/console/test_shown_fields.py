"""Authentication, class and despeckling of contacts in lists, versions, map, exports and report, and where unknown."""

import csv
import io

import pytest
from builders.console import FIRST_UTC_S, image_record

from sonarpost.messages import Command

RECORD_FIELDS = ("authenticated", "despeckle_strength")
CLASS_FIELDS = ("atd_class", "p_mine_like", "p_other_object")
CONTACTS = {
    "0001": (True, 1.0, "mine_like", 0.85, 0.1),
    "0002": (False, 0.0625, "structure", 0.0, 0.95),
    "0003": (None, 0.0, "structure", None, None),
    "0004": (None, None, None, None, None),
}
UNKNOWN = '<span class="missing">unknown</span>'


def record(image_id, values, number=0, version=1):
    of_record, of_class = values[:2], values[2:]
    fields = dict(zip(CLASS_FIELDS, of_class, strict=True))
    made = image_record(image_id, version, time_utc_s=FIRST_UTC_S - number, **fields)
    return made.model_copy(update=dict(zip(RECORD_FIELDS, of_record, strict=True)))


def fill(console):
    for number, (image_id, values) in enumerate(CONTACTS.items()):
        console.state.store_image(record(image_id, values, number))
    console.state.store_image(image_record("0005").model_copy(update={"contact": None}))
    return console


@pytest.fixture(scope="module")
def watcher(make_shared_console):
    return fill(make_shared_console()).browser("watch")


def test_lists_versions_and_records_state_the_fields(watcher):
    rows = watcher.rows()
    for image_id, values in (CONTACTS | {"0005": CONTACTS["0004"]}).items():
        row, detail = rows[image_id], watcher.contact(rows[image_id]["id"])
        [version] = detail["versions"]
        assert (row["authenticated"], *(row[name] for name in CLASS_FIELDS)) == (values[0], *values[2:])
        assert tuple(version[name] for name in RECORD_FIELDS) == values[:2]
        if image_id == "0005":
            assert detail["record"] is None
        else:
            assert tuple(detail["record"][name] for name in CLASS_FIELDS) == values[2:]
    assert set(watcher.rows(q="structure")) == {"0002", "0003"}


def test_map_and_exports_state_the_fields(watcher):
    found = {image_id: one["atd_class"] for image_id, one in watcher.chart().items()}
    assert found == {image_id: values[2] for image_id, values in CONTACTS.items()}
    rows = csv.DictReader(io.StringIO(watcher.get("/api/export/contacts.csv").text))
    assert [row["image_id"] for row in rows if row["authenticated"] == "false"] == ["0002"]
    assert watcher.get("/api/export/contacts.geojson").text.count('"authenticated": false') == 1


def test_report_states_the_fields(watcher):
    labels = ("Class of the detector", "Probabilities of the detector", "Despeckling")
    found, unauthenticated = {}, set()
    for image_id, row in watcher.rows().items():
        text = watcher.get(f"/report/{row['id']}").text
        found[image_id] = [text.partition(f"<dt>{one}</dt><dd>")[2].partition("</dd>")[0] for one in labels]
        if "UNAUTHENTICATED" in text:
            unauthenticated.add(image_id)
    assert unauthenticated == {"0002"}
    probabilities = "mine-like 85 %, other object 10 %, seabed 5 %", "mine-like 0 %, other object 95 %, seabed 5 %"
    assert found == {
        "0001": ["mine-like", probabilities[0], "despeckled, strength 1.00"],
        "0002": ["structure", probabilities[1], "despeckled, strength 0.06"],
        "0003": ["structure", UNKNOWN, "not despeckled"],
        "0004": [UNKNOWN, UNKNOWN, UNKNOWN],
        # Without a contact record, the rows about the contact are left out.
        "0005": ["", "", UNKNOWN],
    }


def test_a_later_version_replaces_authentication_and_class(console):
    fill(console).state.store_image(record("0002", CONTACTS["0001"], version=2))
    row = console.browser("watch").rows()["0002"]
    assert (row["authenticated"], row["atd_class"], row["p_mine_like"]) == (True, "mine_like", 0.85)


def test_request_becomes_a_command_for_the_image_without_despeckling(console):
    anna = fill(console).browser("anna")
    ids = {image_id: row["id"] for image_id, row in anna.rows().items()}
    answer = anna.post(f"/api/contacts/{ids['0001']}/requests", {"kind": "original"})
    assert (answer.status_code, answer.json()["kind"]) == (201, "original")
    [item] = console.state.unsent_records()
    assert isinstance(item.record, Command)
    assert (item.record.kind, item.record.image_id, item.record.lat_deg) == ("original", "0001", None)
    assert console.browser("watch").post(f"/api/contacts/{ids['0002']}/requests", {"kind": "original"}).is_error


def test_request_is_refused_for_an_image_that_is_not_despeckled_or_absent(console):
    console.state.store_image(image_record("0006", time_utc_s=FIRST_UTC_S - 9).model_copy(update={"codec": ""}))
    anna = fill(console).browser("anna")
    for image_id, code in (("0003", "not_despeckled"), ("0004", "despeckling_unknown"), ("0006", "no_image")):
        path = f"/api/contacts/{anna.rows()[image_id]['id']}"
        costs = anna.get(path).json()["costs"]
        assert [cost["reason_code"] for cost in costs if cost["kind"] == "original"] == [code]
        answer = anna.post(f"{path}/requests", {"kind": "original"})
        assert answer.status_code == 400
        assert f"another kind: {code}" in answer.text
