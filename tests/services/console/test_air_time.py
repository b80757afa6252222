"""Air time: images that vehicles still send, their order, regions, and the air time that verdicts give back."""

from __future__ import annotations

import pytest
from builders.console import FIRST_UTC_S, image_record

from sonarpost.messages import Command, DownlinkState, Pixels, QueuedImage, QueueState

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def preview(image_id="00A7", received=30, *, complete=False, **fields):
    record = image_record(image_id, 1, **fields)
    total = received if complete else 0
    return record.model_copy(update={"complete": complete, "bytes_received": received, "bytes_total": total})


def queue(console, *images):
    """Set the transmit queue of uuv-1: (image identifier, bytes left)."""
    now = console.state.clock()
    queued = tuple(
        QueuedImage(
            image_id=image_id, contact_id="c", bytes_left=left, preview_utc_s=None, expected_utc_s=now + 10 * place
        )
        for place, (image_id, left) in enumerate(images, 1)
    )
    state = QueueState(
        platform_id="uuv-1",
        time_utc_s=now,
        rate=1,
        frame_loss=None,
        packet_interval_s=6.1,
        messages_waiting=0,
        message_bytes=0,
        images_waiting=len(queued),
        images=queued,
    )
    console.state.fleet.set_queue(state)


def air_time(console):
    answer = console.browser("watch").get("/api/airtime")
    assert answer.status_code == 200
    return answer.json()


def ask(console, status=201, **body):
    answer = console.browser("anna").post(f"/api/contacts/{ID}/requests", body)
    assert answer.status_code == status, answer.text
    return answer.json()


def decide(console, verdict="not_mine_like"):
    anna = console.browser("anna")
    contact = anna.contact(ID)
    shown = contact["versions"][-1]
    body = {
        "verdict": verdict,
        "version": shown["version"],
        "sha256": shown["sha256"],
        "revision": contact["contact"]["revision"],
    }
    answer = anna.post(f"/api/contacts/{ID}/decisions", body)
    assert answer.status_code == 201, answer.text
    return answer.json()["decision"]


def confirm(console, kind, record_id):
    now = console.state.clock()
    console.state.unsent_records()
    console.state.apply_downlink_state(
        DownlinkState(
            vessel_id="vessel-1",
            vehicle_id="uuv-1",
            kind=kind,
            record_id=record_id,
            state="confirmed",
            times_sent=1,
            expires_utc_s=now + 3600.0,
            changed_utc_s=now,
        )
    )


def test_images_are_listed_in_the_order_of_the_queue_with_cost_and_gain(console):
    console.state.store_images([preview("00A7"), preview("00A8", received=200, first_utc_s=FIRST_UTC_S + 60)])
    queue(console, ("00A8", 192), ("00A7", 192))
    [vehicle] = air_time(console)["vehicles"]
    assert (vehicle["vehicle_id"], vehicle["basis"]) == ("uuv-1", "queue")
    assert [image["id"].rsplit(".", 1)[1] for image in vehicle["images"]] == ["00A8", "00A7"]
    later, first = vehicle["images"]
    assert first["cost_s"] == later["cost_s"] > 0
    assert first["gain_per_s"] > later["gain_per_s"] > 0
    assert vehicle["proposal"]["send"][0]["id"] == ID


def test_final_verdict_gives_air_time_back_when_the_vehicle_confirms_it(console):
    console.state.store_image(preview())
    queue(console, ("00A7", 384))
    decision = decide(console)
    given_back = air_time(console)["given_back"]
    assert given_back["total_s"] == 0
    assert [each["bytes_left"] for each in given_back["decisions"]] == [384]
    confirm(console, "decision", decision["decision_id"])
    given_back = air_time(console)["given_back"]
    assert given_back["total_s"] == pytest.approx(given_back["decisions"][0]["seconds"], abs=0.1)
    assert given_back["total_s"] > 5


def test_unsure_verdict_gives_no_air_time_back(console):
    console.state.store_image(preview())
    queue(console, ("00A7", 384))
    decide(console, "unsure")
    assert air_time(console)["given_back"]["decisions"] == []


def test_request_for_a_place_in_the_queue_is_sent(console):
    console.state.store_image(preview())
    request = ask(console, kind="prioritise", place="first")
    [item] = console.state.unsent_records()
    assert isinstance(item.record, Command)
    assert (item.record.kind, item.record.place, item.record.command_id) == (
        "prioritise",
        "first",
        request["command_id"],
    )
    confirm(console, "prioritise", request["command_id"])
    ask(console, kind="prioritise", place="last")


@pytest.mark.parametrize(
    "body",
    [
        {"kind": "prioritise"},
        {"kind": "prioritise", "place": "second"},
        {"kind": "region", "box": [0, 0, 32, 32]},
        {"kind": "region", "stream_bytes": 96},
        {"kind": "region", "box": [8, 0, 8, 32], "stream_bytes": 96},
        {"kind": "region", "box": [0, 0, 33, 32], "stream_bytes": 96},
        {"kind": "region", "box": [0, 0, 32, 32], "stream_bytes": 513},
        {"kind": "region", "box": [0, 0, 32, 32], "stream_bytes": 23},
    ],
)
def test_incomplete_and_invalid_requests_are_rejected(console, body):
    console.state.store_image(preview())
    ask(console, status=400, **body)
    assert console.state.unsent_records() == []


def test_region_arrives_as_a_layer_with_its_place(console):
    whole = preview(received=200, complete=True)
    console.state.store_image(whole)
    height, width = whole.picture.height_px, whole.picture.width_px
    ask(console, kind="region", box=[0, 16, 16, 32], stream_bytes=96)
    pixels = Pixels.from_array(whole.picture.to_array()[: -(-height // 2), width // 2 :])
    part = preview("00B0", received=96, complete=True, first_utc_s=FIRST_UTC_S + 60)
    changes = {"contact": whole.contact, "picture": pixels, "picture_sha256": pixels.sha256, "missing_mask": b""}
    console.state.store_image(part.model_copy(update=changes))
    detail = console.browser("watch").contact(ID)
    [layer] = detail["related"]
    assert (layer["relation"], layer["place_px"]) == ("region", [0, width // 2, -(-height // 2), width])
    [request] = detail["requests"]
    assert request["arrived_utc_s"] is not None
    ask(console, kind="region", box=[0, 0, 16, 16], stream_bytes=96)
