"""Air time: images that vehicles still send, their order, regions, and the air time that verdicts give back."""

from __future__ import annotations

import pytest
from builders.console import FIRST_UTC_S, contact_id, downlink_state, partial_record, queue_state

from sonarpost.messages import Command, Pixels

ID = contact_id()


def queue(console, *images):
    """Set the transmit queue of uuv-1: (image identifier, bytes left)."""
    now = console.state.clock()
    queued = [(image_id, left, now + 10 * place) for place, (image_id, left) in enumerate(images, 1)]
    console.state.fleet.set_queue(queue_state(queued, now))


def air_time(console):
    answer = console.browser("watch").get("/api/airtime")
    assert answer.status_code == 200
    return answer.json()


def ask(console, status=201, **body):
    answer = console.browser("anna").post(f"/api/contacts/{ID}/requests", body)
    assert answer.status_code == status, answer.text
    return answer.json()


def confirm(console, kind, record_id):
    console.state.unsent_records()
    console.state.apply_downlink_state(downlink_state(kind, record_id, "confirmed", console.state.clock()))


def test_images_are_listed_in_the_order_of_the_queue_with_cost_and_gain(console):
    later = partial_record("00A8", received=200, first_utc_s=FIRST_UTC_S + 60)
    console.state.store_images([partial_record(), later])
    queue(console, ("00A8", 192), ("00A7", 192))
    [vehicle] = air_time(console)["vehicles"]
    assert (vehicle["vehicle_id"], vehicle["basis"]) == ("uuv-1", "queue")
    assert [image["id"].rsplit(".", 1)[1] for image in vehicle["images"]] == ["00A8", "00A7"]
    later, first = vehicle["images"]
    assert first["cost_s"] == later["cost_s"] > 0
    assert first["gain_per_s"] > later["gain_per_s"] > 0
    assert vehicle["proposal"]["send"][0]["id"] == ID


def test_final_verdict_gives_air_time_back_when_the_vehicle_confirms_it(console):
    console.state.store_image(partial_record())
    queue(console, ("00A7", 384))
    anna = console.browser("anna")
    assert anna.decide(ID, verdict="unsure").status_code == 201
    assert air_time(console)["given_back"]["decisions"] == []
    decision = anna.decide(ID, verdict="not_mine_like").json()["decision"]
    given_back = air_time(console)["given_back"]
    assert given_back["total_s"] == 0
    assert [each["bytes_left"] for each in given_back["decisions"]] == [384]
    confirm(console, "decision", decision["decision_id"])
    given_back = air_time(console)["given_back"]
    assert given_back["total_s"] == pytest.approx(given_back["decisions"][0]["seconds"], abs=0.1)
    assert given_back["total_s"] > 5


def test_request_for_a_place_in_the_queue_is_sent(console):
    console.state.store_image(partial_record())
    request = ask(console, kind="prioritise", place="first")
    [item] = console.state.unsent_records()
    sent = item.record
    assert isinstance(sent, Command)
    assert (sent.kind, sent.place, sent.command_id) == ("prioritise", "first", request["command_id"])
    confirm(console, "prioritise", request["command_id"])
    ask(console, kind="prioritise", place="last")


def test_incomplete_and_invalid_requests_are_rejected(console):
    console.state.store_image(partial_record())
    whole, stream = {"box": [0, 0, 32, 32]}, {"stream_bytes": 96}
    for body in ({}, {"place": "second"}):
        ask(console, status=400, kind="prioritise", **body)
    boxes = [{"box": box} | stream for box in ([8, 0, 8, 32], [0, 0, 33, 32])]
    for body in (whole, stream, *boxes, whole | {"stream_bytes": 513}, whole | {"stream_bytes": 23}):
        ask(console, status=400, kind="region", **body)
    assert console.state.unsent_records() == []


def test_region_arrives_as_a_layer_with_its_place(console):
    whole = partial_record(received=200, complete=True)
    console.state.store_image(whole)
    height, width = whole.picture.height_px, whole.picture.width_px
    ask(console, kind="region", box=[0, 16, 16, 32], stream_bytes=96)
    pixels = Pixels.from_array(whole.picture.to_array()[: -(-height // 2), width // 2 :])
    part = partial_record("00B0", received=96, complete=True, first_utc_s=FIRST_UTC_S + 60)
    changes = {"contact": whole.contact, "picture": pixels, "picture_sha256": pixels.sha256, "missing_mask": b""}
    console.state.store_image(part.model_copy(update=changes | {"despeckle_strength": None}))
    detail = console.browser("watch").contact(ID)
    [layer] = detail["related"]
    assert (layer["relation"], layer["place_px"]) == ("region", [0, width // 2, -(-height // 2), width])
    [request] = detail["requests"]
    assert request["arrived_utc_s"] is not None
    ask(console, kind="region", box=[0, 0, 16, 16], stream_bytes=96)
