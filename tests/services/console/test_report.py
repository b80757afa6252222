"""Report and target sheets: facts in words, lines, training mark, limits."""

import pytest
from builders.console import contact_id, image_record
from starlette.testclient import TestClient

from sonarpost.services.console.web import report
from sonarpost.services.console.web.access import COOKIE
from sonarpost.services.console.web.report import degrees_minutes
from sonarpost.services.console.web.server import ConsoleApp

ID = contact_id()


def test_verdict_is_in_words_and_a_withdrawal_names_its_operator(console):
    console.state.store_image(image_record())
    anna = console.browser("anna")
    text = anna.get(f"/report/{ID}").text
    assert "<dt>Verdict</dt><dd>unreviewed</dd>" in text
    assert "Decided" not in text
    assert "TRAINING" not in text
    decision = anna.decide(ID).json()["decision"]
    text = anna.get(f"/report/{ID}").text
    assert "<dt>Verdict</dt><dd>mine-like</dd>" in text
    assert "<dt>Confidence of the operator</dt><dd>80 %</dd>" in text
    assert anna.undo(ID, decision["decision_id"]).status_code == 201
    text = anna.get(f"/report/{ID}").text
    assert "<dd>unreviewed (decision withdrawn by anna)</dd>" in text
    assert "mine_like" not in text
    export = anna.get("/api/export/contacts.geojson").json()["features"][0]["properties"]
    assert (export["review"], export["withdrawn_by"]) == ("unreviewed", "anna")


def test_kept_measurements_are_in_report_and_exports(console):
    console.state.store_image(image_record())
    anna = console.browser("anna")
    before = anna.get(f"/report/{ID}").text
    body = {"version": 1, "layer": "raw", "kind": "length", "from": [10, 20], "to": [30, 20], "keep": True}
    measured = anna.post(f"/api/contacts/{ID}/measure", body).json()
    text = anna.get(f"/report/{ID}").text
    size = f"{measured['value_m']:.2f} ± {measured['sigma_m']:.2f} m"
    assert f"<dt>Measured</dt><dd>L {size}</dd>" in text
    # The line is in the image.
    assert text.partition("base64,")[2][:90000] != before.partition("base64,")[2][:90000]
    export = anna.get("/api/export/contacts.geojson").json()["features"][0]["properties"]
    assert export["measured_length_m"] == pytest.approx(measured["value_m"], abs=1e-3)


def test_report_of_training_is_marked(console):
    console.state.store_image(image_record())
    app = ConsoleApp(console.state, console.users, "vessel-1", training=True)
    with TestClient(app.asgi, base_url="http://127.0.0.1") as client:
        client.cookies.set(COOKIE, console.users.start_session("anna").token)
        assert "<p class='training'>TRAINING" in client.get(f"/report/{ID}").text


def test_target_sheets_are_those_of_the_filter_and_limited(console, monkeypatch):
    for number in range(3):
        console.state.store_image(image_record(f"000{number}", first_utc_s=1_700_000_000.0 + number))
    watch = console.browser("watch")
    assert watch.get("/report").text.count("class='sheet'") == 3
    assert watch.get("/report", q="0001").text.count("class='sheet'") == 1
    monkeypatch.setattr(report, "MAX_SHEETS", 2)
    answer = watch.get("/report")
    assert (answer.status_code, answer.json()["error"]["code"]) == (413, "too_large")
    assert "more than 2 contacts" in answer.json()["error"]["message"]


def test_degrees_and_minutes():
    assert degrees_minutes(-5.5125, "EW") == "5° 30.7500\N{PRIME} W"
    assert degrees_minutes(0.0, "EW") == "0° 00.0000\N{PRIME} E"
    # Rounding carries into the degrees.
    assert degrees_minutes(9.9999999999, "EW") == "10° 00.0000\N{PRIME} E"
