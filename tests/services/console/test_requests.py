"""Results of requests, what a vehicle cannot do, and images that answer requests as layers of their contact."""

import pytest
from builders.console import FIRST_UTC_S, Clock, contact_id, downlink_state, image_record, partial_record

from sonarpost.messages import Command, Pixels
from sonarpost.modem.registry import modem_driver
from sonarpost.review.costs import LinkRecord, RequestCost, expected_arrival
from sonarpost.services.console.store.requests import FRAME_HEADER_BYTES, REFUSAL_VALID_S

ID = contact_id()


def store(console, version=1, received=200, *, complete=True, total=0):
    """Store a version of contact 00A7."""
    console.state.store_image(partial_record("00A7", version, received, complete=complete, total=total))


def related(kind, version=1, *, complete=True, received=300, **fields):
    """The image that answers a request about contact 00A7."""
    scale = 2.02 if kind == "expand" else 1.0  # the link transmits pixel sizes in steps of 2.5 %
    sizes = {"pixel_along_m": 0.1 * scale, "pixel_across_m": 0.05 * scale, **fields}
    times = {"first_utc_s": FIRST_UTC_S + 60, "time_utc_s": FIRST_UTC_S - 100}
    record = partial_record("00A9", version, received, complete=complete, **times, **sizes)
    return record.model_copy(update={"despeckle_strength": 1.0 if kind == "expand" else 0.0})


def ask(console, kind="refine", contact_id=ID, status=201, **body):
    body |= {"kind": kind, "airtime_s": 12.0}
    answer = console.browser("anna").post(f"/api/contacts/{contact_id}/requests", body)
    assert answer.status_code == status, answer.text
    return answer.json()


def requests_of(console, contact_id=ID):
    return console.browser("watch").contact(contact_id)["requests"]


def downlink(console, request, state, reason=""):
    now = console.state.clock()
    console.state.apply_downlink_state(
        downlink_state(request["kind"], request["command_id"], state, now, reason=reason)
    )


def costs(console, contact_id=ID):
    return {cost["kind"]: cost for cost in console.browser("anna").contact(contact_id)["costs"]}


def test_refine_request_is_answered_by_the_complete_longer_stream(console):
    store(console)
    request = ask(console)
    downlink(console, request, "confirmed")
    store(console, 2, 260, complete=False)
    [arriving] = requests_of(console)
    assert (arriving["arrived_utc_s"], arriving["result"]) == (None, {"id": ID, "version": 2, "bytes": 60})
    store(console, 3, 400)
    [arrived] = requests_of(console)
    assert arrived["arrived_utc_s"] is not None
    assert arrived["result"] == {"id": ID, "version": 3, "bytes": 200}
    assert console.browser("watch").contact(ID)["contact"]["open_requests"] == 0
    store(console, 4, 800)
    assert requests_of(console)[0] == arrived


def test_complete_image_answers_a_resend_request_and_no_refine_request_for_announced_bytes(console):
    store(console, received=100, complete=False, total=200)
    ask(console)
    ask(console, "resend")
    store(console, 2, 200)
    found = {request["kind"]: request for request in requests_of(console)}
    assert found["refine"]["arrived_utc_s"] is None
    assert found["resend"]["result"] == {"id": ID, "version": 2, "bytes": 100}


def test_revisit_request_is_answered_by_a_later_look_of_the_vehicle(console):
    now = Clock(console, FIRST_UTC_S + 1000.0).now_utc_s
    store(console)
    ask(console, "revisit")
    console.state.store_image(image_record("00B1", vehicle="uuv-2", first_utc_s=now + 500))
    assert requests_of(console)[0]["arrived_utc_s"] is None
    console.state.store_image(image_record("00B2", first_utc_s=now + 500))
    assert requests_of(console)[0]["result"]["id"].endswith(".00B2")


@pytest.mark.parametrize("kind", ["expand", "original"])
def test_answer_to_a_request_is_a_layer_of_its_contact(kind, console):
    store(console)
    ask(console, kind)
    console.state.store_image(related(kind, complete=False, received=30))
    console.state.store_image(related(kind, 2))
    watch = console.browser("watch")
    listed = watch.get("/api/contacts").json()
    assert (listed["total"], listed["to_do"], listed["matching"]) == (1, 1, 1)
    assert [row["id"] for row in listed["items"]] == [ID]
    assert [one["id"] for one in watch.chart().values()] == [ID]
    assert watch.get("/api/export/contacts.geojson").text.count('"Feature"') == 1
    detail = watch.contact(ID)
    [layer] = detail["related"]
    assert (layer["relation"], [one["version"] for one in layer["versions"]]) == (kind, [1, 2])
    assert watch.get(f"/api/contacts/{layer['id']}/versions/2/image.png").status_code == 200
    [request] = detail["requests"]
    assert request["result"] == {"id": layer["id"], "version": 2, "bytes": 300}
    assert request["arrived_utc_s"] is not None
    assert costs(console)[kind]["reason_code"] == "here"


def test_layer_that_arrives_before_its_contact_is_linked(console):
    console.state.store_image(related("expand"))
    assert console.state.counts().total == 1
    store(console)
    listed = console.browser("watch").get("/api/contacts").json()
    assert [row["id"] for row in listed["items"]] == [ID]


def test_other_detections_and_equal_images_stay_contacts(make_console):
    changes = ({"position": (56.0001, -5.0)}, {"altitude_m": 5.5}, {"pixel_across_m": 0.05}, {"vehicle": "uuv-2"})
    others = [related("expand", **change) for change in changes]
    # A vehicle that has lost its state can send a contact twice: nothing shows that a request was answered.
    for other in (*others, related("original").model_copy(update={"despeckle_strength": 1.0})):
        console = make_console()
        store(console)
        console.state.store_image(other)
        assert console.state.counts().total == 2


def test_image_with_a_decision_stays_a_contact(console):
    console.state.store_image(related("expand"))
    [row] = console.browser("watch").get("/api/contacts").json()["items"]
    assert console.browser("anna").decide(row["id"]).status_code == 201
    store(console)
    assert console.state.counts().total == 2


def test_vehicle_without_a_consumer_is_remembered(console):
    clock = Clock(console)
    store(console)
    console.state.store_image(image_record("00B2", position=(57.0, -5.0)))
    other = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00B2"
    downlink(console, ask(console, "revisit"), "refused", "unsupported")
    # Another refusal does not exclude its kind.
    downlink(console, ask(console), "refused", "unknown image")
    found = costs(console, other)
    assert found["revisit"]["reason_code"] == "unsupported"
    assert costs(console)["refine"]["reason_code"] is None
    assert found["refine"]["reason_code"] is None
    ask(console, "revisit", other, 400)
    clock.advance(REFUSAL_VALID_S + 1.0)
    assert costs(console, other)["revisit"]["reason_code"] is None


def test_vessel_without_downlink_offers_no_requests(make_console):
    console = make_console(command_consumers=())
    store(console)
    assert {cost["reason_code"] for cost in costs(console).values()} == {"no_downlink"}
    ask(console, status=400)


def test_pending_request_excludes_another_of_its_kind_until_it_is_late(console):
    clock = Clock(console)
    store(console)
    request = ask(console)
    downlink(console, request, "confirmed")
    ask(console, status=400)
    clock.now_utc_s = requests_of(console)[0]["late_utc_s"] + 1.0
    ask(console)


def test_expected_time_follows_the_repetitions_and_durations_of_earlier_requests(make_console):
    console = make_console(assumed_rate=1)
    clock = Clock(console)
    store(console)
    before = costs(console)["refine"]
    first = ask(console)
    assert first["expected_utc_s"] == pytest.approx(clock.now_utc_s + before["median_s"])
    assert first["probable_utc_s"] == pytest.approx(clock.now_utc_s + before["most_s"])
    assert first["late_utc_s"] > first["probable_utc_s"] > first["expected_utc_s"]
    # The vehicle confirms the third copy, and the answer takes eight times as long as expected.
    now = console.state.clock()
    state = downlink_state("refine", first["command_id"], "confirmed", now, times_sent=3)
    console.state.apply_downlink_state(state)
    clock.advance(8 * before["median_s"])
    store(console, 2, 400)
    store(console, 3, 800)
    after = costs(console)["expand"]
    assert (after["packets_sent"], after["packets_lost"], after["past_requests"]) == (3, 2, 1)
    assert after["loss_up"] is None
    # 8^(1/3): one ratio of 8 and two of 1.
    rate = modem_driver().capabilities.rates[1]
    cost = RequestCost(3.2, 2 * 6.1, after["bytes"], after["bytes"])
    unscaled = expected_arrival(cost, rate, FRAME_HEADER_BYTES, LinkRecord(None, 3, 2))
    assert after["median_s"] == pytest.approx(2 * unscaled.median_s)
    assert ask(console, "expand")["expected_utc_s"] == pytest.approx(clock.now_utc_s + after["median_s"])


def test_gain_is_the_smallest_detail_before_and_after(make_console):
    console = make_console(assumed_rate=1)
    store(console, received=60)
    found = costs(console)
    sharp_to_m = console.browser("anna").contact(ID)["versions"][-1]["sharp_to_m"]
    for kind in ("refine", "region"):
        assert found[kind]["detail_m"] == sharp_to_m > found[kind]["new_detail_m"]
    assert found["expand"]["new_detail_m"] is None
    assert found["region"]["bytes"] == 192


def test_send_next_moves_an_incomplete_image_to_the_front(console):
    store(console, received=100, complete=False, total=200)
    assert costs(console)["prioritise"]["airtime_s"] == costs(console)["revisit"]["airtime_s"] > 0
    request = ask(console, "prioritise")
    [item] = console.state.unsent_records()
    assert isinstance(item.record, Command)
    assert (item.record.kind, item.record.image_id, item.record.place) == ("prioritise", "00A7", "first")
    ask(console, "prioritise", status=400)
    assert console.browser("watch").contact(ID)["contact"]["open_requests"] == 1
    downlink(console, request, "confirmed")
    assert console.browser("watch").contact(ID)["contact"]["open_requests"] == 0
    # Another image may have been sent before it since then.
    ask(console, "prioritise")
    store(console, 2, 200)
    assert costs(console)["prioritise"]["reason_code"] == "complete"


def test_invalid_regions_are_rejected(console):
    console.state.store_image(partial_record())
    whole, stream = {"box": [0, 0, 32, 32]}, {"stream_bytes": 96}
    boxes = [{"box": box} | stream for box in ([8, 0, 8, 32], [0, 0, 33, 32])]
    for body in (whole, stream, *boxes, whole | {"stream_bytes": 513}, whole | {"stream_bytes": 23}):
        ask(console, "region", status=400, **body)
    assert console.state.unsent_records() == []


def test_region_arrives_as_a_layer_with_its_place(console):
    whole = partial_record(received=200, complete=True)
    console.state.store_image(whole)
    height, width = whole.pixels.height_px, whole.pixels.width_px
    ask(console, "region", box=[0, 16, 16, 32], stream_bytes=96)
    pixels = Pixels.from_array(whole.pixels.to_array()[: -(-height // 2), width // 2 :])
    part = partial_record("00B0", received=96, complete=True, first_utc_s=FIRST_UTC_S + 60)
    changes = {"contact": whole.contact, "pixels": pixels, "pixels_sha256": pixels.sha256, "missing_mask": b""}
    console.state.store_image(part.model_copy(update=changes | {"despeckle_strength": None}))
    detail = console.browser("watch").contact(ID)
    [layer] = detail["related"]
    assert (layer["relation"], layer["box"]) == ("region", [0, width // 2, -(-height // 2), width])
    [request] = detail["requests"]
    assert request["arrived_utc_s"] is not None
    ask(console, "region", box=[0, 0, 16, 16], stream_bytes=96)
