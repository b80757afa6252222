"""The integrity line, version buttons, requests and layers of a contact, in Chromium."""

import json
import re

import numpy as np
import pytest
from builders.common import eventually
from builders.console import FIRST_UTC_S, downlink_state, image_record, partial_record, with_pixels

from sonarpost.codec.region import RegionBox
from sonarpost.messages import Command

LARGE = {"width": 1920, "height": 1080}
SELECTED = '[data-tool="layer-{}"][aria-pressed="true"]'


def sent_record(version, received):
    return partial_record("00A7", version, received, complete=True)


def expanded_record():
    fields = {"first_utc_s": FIRST_UTC_S + 60, "time_utc_s": FIRST_UTC_S - 100}
    return partial_record("00A9", 1, 300, complete=True, pixel_along_m=0.2, pixel_across_m=0.1, **fields)


def mean_grey(visit, left, top, right, bottom):
    """Mean grey level of the canvas in a rectangle, in CSS pixels."""
    return visit.page.evaluate(
        """([left, top, right, bottom]) => {
          const ratio = devicePixelRatio || 1;
          const copy = new OffscreenCanvas((right - left) * ratio, (bottom - top) * ratio);
          const context = copy.getContext('2d', {willReadFrequently: true});
          context.drawImage(document.querySelector('.stage canvas'), -left * ratio, -top * ratio);
          const pixels = context.getImageData(0, 0, copy.width, copy.height).data;
          let sum = 0;
          for (let i = 0; i < pixels.length; i += 4) sum += pixels[i];
          return (4 * sum) / pixels.length;
        }""",
        [left, top, right, bottom],
    )


def outline(visit):
    """Left, top, right and bottom of the only outline on the canvas, in CSS pixels."""
    corners = json.loads(visit.page.locator(".stage canvas").first.get_attribute("data-outlines"))
    assert len(corners) == 4
    (left, top), (right, bottom) = corners[0], corners[2]
    return left, top, right, bottom


def shows_layer(visit, layer):
    visit.wait(SELECTED.format(layer))
    visit.until("layer => document.querySelector('canvas').dataset.shows.endsWith(` ${layer}`)", layer)


@pytest.fixture
def v1_page(serve):
    """A console with two versions of a contact, as the v1 link delivers them, and its page."""
    served = serve(assumed_rate=1)
    served.state.store_image(partial_record())
    served.state.store_image(sent_record(2, 131))

    def downlink(state, reason=""):
        request, now = served.contact()["requests"][0], served.state.clock()
        changes = {"times_sent": 2, "reason": reason}
        served.state.apply_downlink_state(downlink_state(request["kind"], request["command_id"], state, now, **changes))

    served.downlink = downlink
    visit = served.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    return served, visit


def test_integrity_line_and_newer_versions_that_do_not_move_the_image(v1_page):
    served, visit = v1_page
    strip = visit.text(".strip").replace("\u202f", " ")
    assert strip.startswith("131 B")
    # With the digits of the requests, so that what they have gained is in sight.
    assert f"sharp to ≈ {served.contact()['versions'][-1]['sharp_to_m']:.2f} m" in strip
    assert "shared" in visit.page.locator(".image-data").text_content()
    for untrue in ("0.0", "frames", "100", "synthetic"):
        assert untrue not in strip
    visit.page.locator('.versions [data-version="1"]').click()
    visit.wait('.versions [data-version="1"][aria-pressed="true"]')
    visit.wait(".strip >> text=preview 30")
    assert "%" not in visit.text(".row .share") + visit.text(".versions")
    before = visit.page.locator(".stage").bounding_box()
    for version, received in ((3, 314), (4, 629)):
        served.state.store_image(sent_record(version, received))
    visit.wait('.versions [data-version="4"] .newer')
    assert visit.page.locator(".stage").bounding_box() == before
    assert visit.page.locator(".versions > span").count() == 0
    visit.page.locator('.versions [data-version="4"]').click()
    visit.until("() => document.querySelectorAll('.versions .newer').length === 0")
    assert visit.page.locator(".stage").bounding_box() == before


def test_codebook_texture_is_named_and_a_vessel_without_downlink_shows_no_buttons(serve):
    served = serve(command_consumers=())
    served.state.store_image(image_record().model_copy(update={"codec": "vq"}))
    visit = served.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    strip = visit.text(".strip")
    assert "texture from a codebook, edges ± 10 px" in strip
    visit.wait(".request-buttons >> text=This vessel sends no requests")
    assert visit.page.locator("[data-request]").count() == 0


@pytest.mark.firefox
def test_request_runs_from_order_to_arrival_or_refusal(v1_page):
    served, visit = v1_page
    button = visit.page.locator('[data-request="refine"]')
    # 131 of 262 bytes, three frames: one packet of 3.2 s down, one of 6.1 s up.
    name, cost = button.inner_text().replace("\u202f", " ").split("\n")
    assert name.strip() == "Sharper"  # no smaller detail than 131 B have
    assert cost == "9.3 s on air · arrives in about 30 s, loss assumed"
    assert "9 of 10 answers arrive within" in button.get_attribute("title")
    assert "not measured" in button.get_attribute("title")
    button.click()
    visit.wait(".request-states >> text=ordered")
    assert visit.page.locator("dialog").count() == 0
    assert button.is_disabled()
    served.downlink("confirmed")
    visit.wait(".request-states >> text=accepted by the vehicle; answer pending")
    countdown = visit.page.locator(".request-states [data-kind=refine] .countdown")
    first = countdown.inner_text()
    assert re.fullmatch(r"; in about \d+\s*s, 9 of 10 within .*", first)
    visit.until("first => document.querySelector('.request-states .countdown').textContent !== first", first)
    served.state.store_image(partial_record("00A7", 3, 196))
    visit.wait(".request-states >> text=arriving 50")
    served.state.store_image(sent_record(4, 262))
    visit.wait(".request-states >> text=arrived: v4 (+131")
    visit.until("() => !document.querySelector('[data-request=refine]').disabled")
    assert "refined 262" in visit.text(".strip")
    # Another kind with the keyboard; the vehicle does not support it, and it is not offered again.
    visit.page.locator('[data-request="revisit"]').focus()
    visit.press("Enter")
    visit.wait(".request-states >> text=after the vehicle has passed the position")
    served.downlink("refused", "unsupported")
    visit.wait(".request-buttons >> text=Second pass: uuv-1 cannot do this")
    visit.wait(".request-states >> text=uuv-1 cannot do this (refused, 2 tries)")
    assert visit.page.locator('[data-request="revisit"]').count() == 0


def test_request_of_unknown_cost_is_confirmed_and_a_phone_has_a_menu(served):
    served.state.store_image(sent_record(1, 60))  # no rate is known
    visit = served.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    text = visit.page.locator('[data-request="refine"]').inner_text().replace("\u202f", " ")
    assert text == "Sharper 0.27 → 0.24 m\ncost unknown"
    visit.page.locator('[data-request="refine"]').click()
    visit.wait("dialog >> text=The cost is not known")
    visit.press("Escape")
    visit.until("() => !document.querySelector('dialog')")
    assert served.contact()["requests"] == []
    visit.resize(390, 844)
    visit.page.locator(".request-menu").click()
    visit.page.locator("dialog [data-request=expand]").wait_for()
    visit.page.locator("dialog [data-request=refine]").click()
    visit.wait("dialog >> text=The cost is not known")
    visit.page.locator('dialog [data-action="send"]').click()
    visit.until("() => !document.querySelector('dialog')")
    # The dialog closes before the request is stored.
    eventually(lambda: [one["kind"] for one in served.contact()["requests"]] == ["refine"], what="the request")


def test_observer_sees_the_preview_and_no_request_buttons(served):
    served.state.store_image(partial_record())
    visit = served.visit("watch", viewport=LARGE)
    visit.wait_for_contact("00A7")
    assert visit.text(".row .share").replace("\u202f", " ") == "preview 30 B"
    assert not visit.page.locator(".requests").is_visible()


@pytest.mark.firefox
def test_expanded_view_is_a_layer_of_its_contact(v1_page):
    served, visit = v1_page
    visit.page.locator('[data-request="expand"]').click()
    visit.wait(".request-states >> text=ordered")
    served.state.store_image(expanded_record())
    visit.wait(".request-states >> text=arrived: expanded view (+300")
    assert visit.page.locator(".row").count() == 1
    assert visit.page.locator('[data-tool="layer-expand"]').count() == 1
    visit.press("-")  # zooming out of the whole image continues into the expanded image
    shows_layer(visit, "expand")
    assert visit.pixels() > 1000
    assert visit.page.locator('[data-tool="measure"]').get_attribute("aria-disabled") == "true"
    visit.page.locator('[data-tool="layer-raw"]').click()
    shows_layer(visit, "raw")
    visit.page.locator(".stage canvas").first.hover()
    visit.page.mouse.wheel(0, 100)
    visit.wait(SELECTED.format("expand"))


@pytest.mark.firefox
def test_expanded_view_surrounds_the_image_at_its_place(serve):
    """The expanded image is darker than the contact's image here, so that the latter can be told apart inside it."""
    blocks = np.random.default_rng(3).integers(100, 250, (20, 30))
    own = np.kron(blocks, np.ones((2, 2))).astype(np.uint8)
    surroundings = np.full((40, 60), 20, np.uint8)
    surroundings[6:26, 20:50] = blocks // 5
    served = serve(assumed_rate=1)
    served.state.store_image(with_pixels(sent_record(1, 131), own))
    served.state.store_image(with_pixels(expanded_record(), surroundings))
    visit = served.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    visit.press("-")
    shows_layer(visit, "expand")
    # The view covers twice the lengths of the contact's image: 40 x 60 px of 0.1 x 0.05 m.
    across_m, along_m = json.loads(visit.page.locator(".stage canvas").first.get_attribute("data-extent"))
    assert (across_m, along_m) == pytest.approx((6.0, 8.0))
    left, top, right, bottom = outline(visit)
    pixel_px = (right - left) / 60
    assert mean_grey(visit, left + 4, top + 4, right - 4, bottom - 4) > 100
    assert mean_grey(visit, left - 20 * pixel_px, top + 4, left - 4 * pixel_px, bottom - 4) < 10
    # The mark of the contact is inside its image; the outline is known to a pixel.
    mark = json.loads(visit.page.locator(".stage canvas").first.get_attribute("data-mark"))
    for x, y in mark:
        assert left - 1 < x < right + 1
        assert top - 1 < y < bottom + 1


@pytest.mark.firefox
def test_region_is_drawn_at_its_place(serve):
    served = serve(assumed_rate=1)
    whole = np.full((40, 60), 30, np.uint8)
    whole[:3] = 220
    served.state.store_image(with_pixels(sent_record(1, 131), whole))
    visit = served.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    visit.page.locator("[data-request=region]").click()
    layer = visit.page.locator(".region-layer")
    layer.wait_for()
    box = layer.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    drawn = box["x"] + 0.55 * box["width"], box["y"] + 0.55 * box["height"]
    visit.page.mouse.move(*middle)
    visit.page.mouse.move(*drawn)
    visit.page.mouse.down()
    visit.page.mouse.move(drawn[0] + 200, drawn[1] + 100)
    visit.page.mouse.up()
    visit.page.get_by_role("dialog").get_by_text("smallest detail").wait_for()
    visit.page.get_by_role("button", name="Send request").click()

    eventually(lambda: len(served.sent(Command)) == 1, what="the request")
    [command] = served.sent(Command)
    assert (command.kind, command.stream_bytes) == ("region", 192)
    # The box begins right of and below the middle.
    assert command.box[0] >= 16
    assert command.box[1] >= 16
    top_px, left_px, bottom_px, right_px = RegionBox(*command.box).pixels(40, 60)
    part = with_pixels(
        partial_record("00A9", 1, 96, complete=True, first_utc_s=FIRST_UTC_S + 60, time_utc_s=FIRST_UTC_S - 100),
        np.full((bottom_px - top_px, right_px - left_px), 220, np.uint8),
    )
    served.state.store_image(part)
    visit.wait(".request-states >> text=arrived: region (+96")
    assert visit.page.locator(".row").count() == 1
    visit.page.locator('[data-tool="layer-region"]').click()
    shows_layer(visit, "region")
    left, top, right, bottom = outline(visit)
    corners = visit.page.locator(".stage canvas").first
    across_m, along_m = json.loads(corners.get_attribute("data-extent"))
    assert (across_m, along_m) == pytest.approx((3.0, 4.0))
    assert (right - left) / (bottom - top) == pytest.approx(
        0.05 * (right_px - left_px) / (0.1 * (bottom_px - top_px)), rel=0.02
    )
    assert mean_grey(visit, left + 4, top + 4, right - 4, bottom - 4) > 150
    assert mean_grey(visit, left + 4, bottom + 8, right - 4, bottom + 14) < 60
    assert mean_grey(visit, left - 14, top + 4, left - 8, bottom - 4) < 60
    # The layer is switched off again: the contact's image alone.
    visit.page.locator('[data-tool="layer-raw"]').click()
    shows_layer(visit, "raw")
    assert corners.get_attribute("data-outlines") == "[]"
    assert mean_grey(visit, left + 4, top + 4, right - 4, bottom - 4) < 60
