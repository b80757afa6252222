"""The console states the despeckling of each image, and sends the command for the image without it."""

from __future__ import annotations

import pytest
from builders.console import FIRST_UTC_S, image_record

from sonarpost.messages import Command

STRENGTHS = {"0001": 1.0, "0002": 0.0625, "0003": 0.0, "0004": None}


@pytest.fixture
def contact_ids(console):
    for number, (image_id, strength) in enumerate(STRENGTHS.items()):
        record = image_record(image_id, time_utc_s=FIRST_UTC_S - number)
        console.state.store_image(record.model_copy(update={"despeckle_strength": strength}))
    rows = console.browser("watch").get("/api/contacts").json()["items"]
    return {row["image_id"]: row["id"] for row in rows}


def test_versions_state_the_strength(console, contact_ids):
    watcher = console.browser("watch")
    for image_id, strength in STRENGTHS.items():
        [version] = watcher.contact(contact_ids[image_id])["versions"]
        assert version["despeckle_strength"] == strength


def test_report_states_the_strength(console, contact_ids):
    watcher = console.browser("watch")
    found = {}
    for image_id, contact_id in contact_ids.items():
        _, _, after = watcher.get(f"/report/{contact_id}").text.partition("<dt>Despeckling</dt><dd>")
        found[image_id] = after.partition("</dd>")[0]
    assert found == {
        "0001": "despeckled, strength 1.00",
        "0002": "despeckled, strength 0.06",
        "0003": "not despeckled",
        "0004": '<span class="missing">unknown</span>',
    }


def test_request_becomes_a_command_for_the_image_without_despeckling(console, contact_ids):
    anna = console.browser("anna")
    answer = anna.post(f"/api/contacts/{contact_ids['0001']}/requests", {"kind": "original"})
    assert (answer.status_code, answer.json()["kind"]) == (201, "original")
    [item] = console.state.unsent_records()
    assert isinstance(item.record, Command)
    assert (item.record.kind, item.record.image_id, item.record.lat_deg) == ("original", "0001", None)
    assert console.browser("watch").post(f"/api/contacts/{contact_ids['0002']}/requests", {"kind": "original"}).is_error


@pytest.mark.parametrize(
    ("image_id", "expected"),
    [
        ("0003", "the image is not despeckled"),
        ("0004", "the stream of the image states no despeckling"),
    ],
)
def test_request_is_refused_for_an_image_that_is_not_despeckled(image_id, expected, console, contact_ids):
    anna = console.browser("anna")
    costs = anna.get(f"/api/contacts/{contact_ids[image_id]}/costs").json()["costs"]
    [reason] = [cost["reason"] for cost in costs if cost["kind"] == "original"]
    assert reason == expected
    answer = anna.post(f"/api/contacts/{contact_ids[image_id]}/requests", {"kind": "original"})
    assert answer.status_code == 400
    assert expected in answer.text


def test_request_is_refused_for_a_contact_without_an_image(console):
    console.state.store_image(image_record("0005").model_copy(update={"codec": ""}))
    anna = console.browser("anna")
    [row] = anna.get("/api/contacts").json()["items"]
    costs = anna.get(f"/api/contacts/{row['id']}/costs").json()["costs"]
    assert [cost["reason"] for cost in costs if cost["kind"] == "original"] == ["no part of the image was received"]
