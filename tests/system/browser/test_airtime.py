"""Air time panel and region requests, in a real browser."""

from __future__ import annotations

import time

from builders.common import eventually
from builders.console import image_record

from sonarpost.messages import Command, QueuedImage, QueueState


def report_queue(served, *image_ids):
    now = time.time()
    images = tuple(
        QueuedImage(
            image_id=name, contact_id="c", bytes_left=192, preview_utc_s=None, expected_utc_s=now + 10.0 * place
        )
        for place, name in enumerate(image_ids, 1)
    )
    served.state.fleet.set_queue(
        QueueState(
            platform_id="uuv-1",
            time_utc_s=now,
            rate=1,
            frame_loss=None,
            packet_interval_s=6.0,
            messages_waiting=0,
            message_bytes=0,
            images_waiting=len(images),
            images=images,
        )
    )


def commands(served):
    return [item.record for item in served.state.unsent_records() if isinstance(item.record, Command)]


def test_panel_orders_the_queue_and_applies_the_proposal(served):
    for name in ("00A7", "00A8"):
        record = image_record(name).model_copy(update={"complete": False, "bytes_received": 30, "bytes_total": 0})
        served.state.store_image(record)
    report_queue(served, "00A7", "00A8")
    page = served.visit("anna").page
    page.keyboard.press("f")
    rows = page.locator(".airtime tbody tr")
    eventually(lambda: rows.count() == 2)
    assert "mbit/s" in rows.first.inner_text()
    rows.nth(1).locator('[data-place="last"]').click()
    eventually(lambda: [(c.kind, c.image_id, c.place) for c in commands(served)] == [("prioritise", "00A8", "last")])
    page.locator(".airtime .apply").click()
    eventually(lambda: "first" in [c.place for c in commands(served)])


def test_box_on_the_image_requests_a_region(served):
    served.state.store_image(image_record("00A7"))
    page = served.visit("anna").page
    page.locator(".stage canvas").first.wait_for()
    eventually(lambda: page.locator('[data-tool="region"]').count() == 1)
    page.keyboard.press("7")
    layer = page.locator(".region-layer")
    layer.wait_for()
    box = layer.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(middle[0] - 60, middle[1] - 60)
    page.mouse.down()
    page.mouse.move(middle[0] + 60, middle[1] + 60)
    page.mouse.up()
    page.get_by_role("dialog").get_by_text("smallest detail").wait_for()
    page.get_by_role("button", name="Send request").click()
    eventually(lambda: [c.kind for c in commands(served)] == ["region"], what="the request")
    [command] = commands(served)
    top, left, bottom, right = command.box
    assert top < 16 < bottom
    assert left < 16 < right
    assert command.stream_bytes == 192
