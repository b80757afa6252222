"""The page of link and fleet, and the empty page, in a real browser."""

import re
import time

from builders.common import eventually
from builders.console import encoded_health, image_record, queue_state, received_frame
from builders.record_samples import SAMPLES

from sonarpost.services.console.chain import RouterState


def listen_since(served, utc_s):
    served.state.router = RouterState(
        platform_id="vessel-1", reached=True, changed_utc_s=utc_s, listening_since_utc_s=utc_s
    )


def test_a_vehicle_is_one_line_with_its_numbers_on_request(served):
    listen_since(served, time.time() - 60)
    now = time.time()
    sample = SAMPLES["received-status"]
    status = sample.status.model_copy(update={"time_utc_s": now - 60, "disk_free_bytes": 77_935_877_489})
    served.state.store_status(sample.model_copy(update={"status": status, "received_utc_s": now}))
    served.state.fleet.set_range(SAMPLES["vehicle-range"])
    served.state.fleet.add_frame("uuv-2", received_frame(now))
    queued = [("0100", 64, now + 90.0), ("0101", 64, now + 419.0)]
    served.state.fleet.set_queue(queue_state(queued, now).model_copy(update={"platform_id": "uuv-2"}))
    served.state.store_image(image_record("0001", vehicle="uuv-3", time_utc_s=1_378_800_000.0))
    for vehicle, gauges in {
        "uuv-1": {"expected_pd": 0.62, "worst_expected_pd": 0.35, "clutter_per_1000_m2": 41.0, "ripple_strength": 0.12},
        "uuv-2": {"expected_pd": 0.96, "worst_expected_pd": 0.91, "clutter_per_1000_m2": 5.0, "ripple_strength": 0.1},
    }.items():
        served.state.fleet.services.add(
            *encoded_health("atd_stub", vehicle, time_utc_s=now, **gauges), time.monotonic()
        )
    visit = served.visit()
    visit.press("f")
    card = '.fleet article[aria-label="uuv-{}"]'
    visit.wait(card.format(3))
    lines = {number: visit.text(card.format(number) + " > p") for number in (1, 2, 3)}
    # The queue of uuv-1 is not reported, its status has the number of images.
    assert re.match("Last frames never · 4 images to send", lines[1])
    assert "Expected Pd 62 % on this seabed; a clean result does not mean no mines" in lines[1].replace("\u202f", " ")
    assert re.fullmatch("Last frames [\\d.]+\u202fs ago · 2 images to send, done in 6\u202fmin \\d\\d\u202fs", lines[2])
    assert "connected" in visit.text(card.format(2))
    assert lines[3] == "Last frames never · send queue not reported"
    assert not visit.page.locator(card.format(1) + " dl").first.is_visible()
    for number in (1, 3):
        visit.page.click(card.format(number) + " summary")
    details = visit.text(card.format(1))
    assert "Measured distance\n740" in details
    assert "Reported status\nheading 272" in details
    assert "disk free 77.9\u202fGB" in details
    assert "41 echoes per 1000 m², 0.1" in details
    # An old position has a date. The next update, a second later, leaves the details open.
    assert "when it last saw a contact, 10 Sep 2013" in visit.text(card.format(3))
    served.state.fleet.set_range(SAMPLES["vehicle-range"].model_copy(update={"distance_m": 750.0}))
    served.state.events.publish("fleet", served.state.fleet_state())
    visit.wait(card.format(1) + " details[open] >> text=750")


def test_empty_page_states_what_it_listens_to(serve):
    since = time.time() - 3600
    served = serve(vehicles={"3": "uuv-1"})
    listen_since(served, since)
    visit = served.visit()
    visit.wait(".no-contacts")
    text = f"No contacts yet. Listening to uuv-1 since {time.strftime('%H:%M UTC', time.gmtime(since))}."
    assert visit.text(".no-contacts") == text
    eventually(lambda: served.state.events.subscriber_count == 1, what="event stream")
    served.state.router = served.state.router.changed(time.time(), reached=False)
    served.state.events.publish("fleet", served.state.fleet_state())
    visit.until("() => document.querySelector('.no-contacts').textContent.includes('The router is not reached')")
    served.state.store_image(image_record("0001"))
    visit.wait_for_contact("0001")
    assert not visit.page.is_visible(".no-contacts")
