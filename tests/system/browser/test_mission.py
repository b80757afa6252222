"""The mission page, the fleet page with air time, and the empty page, in a real browser."""

from __future__ import annotations

import re
import time

from builders.common import eventually
from builders.console import encoded_health, image_record, partial_record, queue_state, received_frame
from builders.record_samples import SAMPLES

from sonarpost.messages import Command
from sonarpost.review.positions import destination
from sonarpost.services.console.chain import RouterState


def listen_since(served, utc_s):
    served.state.router = RouterState(
        platform_id="vessel-1", reached=True, changed_utc_s=utc_s, listening_since_utc_s=utc_s
    )


def test_mission_page_shows_progress_by_vehicle_and_operator(served):
    listen_since(served, time.time() - 60)
    for number in range(4):
        position = (56.0 + 0.001 * (number % 2), -5.0 + 0.001 * (number // 2))
        served.state.store_image(image_record(f"000{number}", position=position, total=100))
    served.state.fleet.add_frame("uuv-1", received_frame())
    now = time.time()
    served.state.fleet.set_queue(queue_state([("0100", 64, now + 600.0)], now))
    visit = served.visit()
    visit.wait_for_contact("0003")
    visit.press("1")
    eventually(lambda: served.state.counts().unreviewed == 3, what="decision")
    visit.press("Shift+M")
    visit.wait('.mission article[aria-label="uuv-1"]')
    card = visit.text('.mission article[aria-label="uuv-1"]')
    assert "Surveyed area\nnot reported" in card
    assert "from the positions of 4 contacts" in card
    assert "Image bytes received\n400" in card
    assert "1 image" in card
    assert re.search("in [3-9]\u202fmin", card)
    assert "Seabed\nnot reported" in card
    # One bar for each hour; the present one has the contacts.
    heights = visit.page.evaluate(
        "() => [...document.querySelectorAll('.mission article rect')].slice(0, 24)"
        ".map(bar => Number(bar.getAttribute('height')))"
    )
    assert len(heights) == 24
    assert sorted(heights) == [0] * 23 + [60]
    operators = visit.text(".mission table")
    assert "anna" in operators
    assert "1 mine-like" in operators
    # A contact that arrives is counted without a reload.
    served.state.store_image(image_record("0009", seed=90))
    visit.until("() => document.querySelector('.mission article dd').textContent.startsWith('5')")
    visit.press("q")
    visit.until("() => document.querySelector('.mission').classList.contains('hidden')")


def test_vehicles_on_the_mission_and_fleet_page(served):
    listen_since(served, time.time() - 60)
    first = SAMPLES["received-status"]
    for number in range(2):
        lat_deg, lon_deg = destination(56.0, -5.0, 90.0, 500.0 * number)
        changes = {"lat_deg": lat_deg, "lon_deg": lon_deg, "time_utc_s": time.time() - 120 + 60 * number}
        status = first.status.model_copy(update=changes)
        served.state.store_status(first.model_copy(update={"status": status, "received_utc_s": time.time()}))
    served.state.fleet.set_range(SAMPLES["vehicle-range"])
    served.state.store_image(image_record("0001", vehicle="uuv-3", time_utc_s=1_378_800_000.0))
    for vehicle, gauges in {
        "uuv-1": {"expected_pd": 0.62, "worst_expected_pd": 0.35, "clutter_per_1000_m2": 41.0, "ripple_strength": 0.12},
        "uuv-2": {"expected_pd": 0.96, "worst_expected_pd": 0.91, "clutter_per_1000_m2": 5.0, "ripple_strength": 0.1},
    }.items():
        health = encoded_health("atd_stub", vehicle, time_utc_s=time.time(), **gauges)
        served.state.fleet.services.add(*health, time.monotonic())
    visit = served.visit()
    visit.press("Shift+M")
    visit.wait('.mission article[aria-label="uuv-1"]')
    card = visit.text('.mission article[aria-label="uuv-1"]')
    assert re.search(r"Surveyed area\n7[3-7]\d{3}\s*m², from 1 section of the track", card), card
    visit.press("f")
    visit.wait('.fleet article[aria-label="uuv-3"]')
    card = visit.text('.fleet article[aria-label="uuv-1"]')
    assert "Measured distance\n740" in card
    assert "Reported status\nheading 272" in card
    assert "4 images" in card
    assert "Expected Pd 62 % on this seabed; a clean result does not mean no mines" in card
    assert "41 echoes per 1000 m², 0.1" in card
    assert "a clean result" not in visit.text('.fleet article[aria-label="uuv-2"]')
    # An old position has a date, and a queue that is not reported is named.
    card = visit.text('.fleet article[aria-label="uuv-3"]')
    assert "when it last saw a contact, 10 Sep 2013" in card
    assert "Send queue of uuv-3: not reported" in card
    assert "Last frames" in card


def test_air_time_panel_orders_the_queue_and_applies_the_proposal(served):
    served.state.store_images([partial_record(name) for name in ("00A7", "00A8")])
    now = time.time()
    served.state.fleet.set_queue(queue_state([("00A7", 192, now + 10.0), ("00A8", 192, now + 20.0)], now))
    page = served.visit().page
    page.keyboard.press("f")
    rows = page.locator(".airtime tbody tr")
    eventually(lambda: rows.count() == 2)
    assert "mbit/s" in rows.first.inner_text()
    rows.nth(1).locator('[data-place="last"]').click()
    asked = ("prioritise", "00A8", "last")
    eventually(lambda: [(c.kind, c.image_id, c.place) for c in served.sent(Command)] == [asked], what="the request")
    page.locator(".airtime .apply").click()
    eventually(lambda: "first" in [c.place for c in served.sent(Command)], what="the proposal")


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
