"""The mission page, the empty page and the wording of the fleet page, in a real browser."""

from __future__ import annotations

import re
import time

from builders.common import eventually
from builders.console import image_record
from builders.record_samples import SAMPLES

from sonarpost.messages import AcousticFrame, QueuedImage, QueueState
from sonarpost.review.positions import destination
from sonarpost.services.console.chain import RouterState


def listen_since(served, utc_s):
    served.state.router = RouterState(
        platform_id="vessel-1", reached=True, changed_utc_s=utc_s, listening_since_utc_s=utc_s
    )


def receive_frame(served, vehicle="uuv-1"):
    frame = AcousticFrame(
        direction="rx",
        platform_id="vessel-1",
        time_utc_s=time.time(),
        source=3,
        destination=1,
        rate=1,
        packet=1,
        frame_number=1,
        frame_count=1,
        data=b"x",
    )
    served.state.fleet.add_frame(vehicle, frame)


def report_queue(served, images, waiting):
    state = QueueState(
        platform_id="uuv-1",
        time_utc_s=time.time(),
        rate=1,
        frame_loss=None,
        packet_interval_s=6.0,
        messages_waiting=0,
        message_bytes=0,
        images_waiting=waiting,
        images=tuple(
            QueuedImage(image_id=f"010{n}", contact_id="c", bytes_left=64, preview_utc_s=None, expected_utc_s=end)
            for n, end in enumerate(images)
        ),
    )
    served.state.fleet.set_queue(state)


def test_mission_page_shows_progress_by_vehicle_and_operator(served):
    listen_since(served, time.time() - 60)
    for number in range(4):
        position = (56.0 + 0.001 * (number % 2), -5.0 + 0.001 * (number // 2))
        served.state.store_image(image_record(f"000{number}", position=position, total=100))
    receive_frame(served)
    report_queue(served, [time.time() + 600.0], waiting=1)
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
    assert "in 9\u202fmin" in card
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


def test_status_of_a_vehicle_on_the_mission_and_fleet_page(served):
    listen_since(served, time.time() - 60)
    first = SAMPLES["received-status"]
    for number in range(2):
        lat_deg, lon_deg = destination(56.0, -5.0, 90.0, 500.0 * number)
        changes = {"lat_deg": lat_deg, "lon_deg": lon_deg, "time_utc_s": time.time() - 120 + 60 * number}
        status = first.status.model_copy(update=changes)
        served.state.store_status(first.model_copy(update={"status": status, "received_utc_s": time.time()}))
    served.state.fleet.set_range(SAMPLES["vehicle-range"])
    visit = served.visit()
    visit.press("Shift+M")
    visit.wait('.mission article[aria-label="uuv-1"]')
    card = visit.text('.mission article[aria-label="uuv-1"]')
    assert re.search(r"Surveyed area\n7[3-7]\d{3}\s*m², from 1 section of the track", card), card
    served.state.events.publish("fleet", served.state.fleet_state())
    visit.press("f")
    visit.wait('.fleet article[aria-label="uuv-1"]')
    card = visit.text('.fleet article[aria-label="uuv-1"]')
    assert "Measured distance\n740" in card
    assert "Reported status\nheading 272" in card
    assert "4 images" in card


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


def test_old_position_has_a_date_and_an_unreported_queue_is_named(served):
    served.state.store_image(image_record("0001", time_utc_s=1_378_800_000.0))
    visit = served.visit()
    visit.press("f")
    visit.wait('.fleet article[aria-label="uuv-1"]')
    card = visit.text('.fleet article[aria-label="uuv-1"]')
    assert "when it last saw a contact, 10 Sep 2013" in card
    assert "Send queue of uuv-1: not reported" in card
    assert "Last frames" in card
