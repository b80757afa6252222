"""The object panel: looks north-up side by side, one verdict, split and join; marks and filter of the queue."""

import numpy as np
import pytest
from builders.console import FIRST_UTC_S, contact_ids, image_record, with_pixels

from sonarpost.review.positions import destination

TWO_TILES = "() => document.querySelectorAll('dialog.object canvas[data-shows]').length === 2"
BRIGHTEST = """id => {
  const canvas = document.querySelector(`dialog.object [data-id="${id}"] canvas`);
  const { data, width } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let sum = 0, x = 0, y = 0;
  for (let i = 0; i < data.length; i += 4) {
    // White pixels, without the labels near the edges.
    const [column, row] = [(i / 4) % width, Math.floor(i / 4 / width)];
    const edge = 0.15 * width;
    if (data[i] < 250 || data[i + 2] < 250) continue;
    if (Math.min(column, row, width - column, canvas.height - row) < edge) continue;
    sum += 1; x += column - width / 2; y += canvas.height / 2 - row;
  }
  return [x / sum / width, y / sum / width];
}"""


def look(image_id, *, heading_deg, channel, vehicle="uuv-1", north_m=0.0, **fields):
    """An image with one bright square: behind the centre in range, and ahead of it along the track."""
    place = {"position": destination(56.0, -5.0, 0.0, north_m), "heading_deg": heading_deg, "channel": channel}
    sizes = {"pixel_along_m": 0.1, "pixel_across_m": 0.1}
    record = image_record(image_id, vehicle=vehicle, **place, **sizes, **fields)
    pixels = np.full((60, 60), 60, np.uint8)
    pixels[::2] = 50
    pixels[36:46, 38:48] = 255
    return with_pixels(record, pixels)


def store_two_looks(served):
    served.state.store_image(look("0001", heading_deg=0.0, channel="starboard"))
    served.state.store_image(look("0002", heading_deg=90.0, channel="port", vehicle="uuv-2", north_m=1.0))
    served.state.store_image(look("0003", heading_deg=0.0, channel="port", vehicle="uuv-1", north_m=-7.5))


def identifier(served, image_id):
    return contact_ids(served.state)[image_id]


def review(served, image_id):
    return served.contact(image_id)["contact"]["review"]


def open_panel(served, **options):
    """Select the first look and open its object."""
    visit = served.visit(**options)
    visit.page.click(f".row[data-id='{identifier(served, '0001')}']")
    visit.wait_for_contact("0001")
    visit.page.click(".open-object")
    visit.until(TWO_TILES)
    return visit


def test_looks_are_drawn_north_up_and_not_mirrored(served):
    store_two_looks(served)
    visit = open_panel(served)
    # The square is 1.1 m ahead of the centre along the track and 1.3 m further in range.
    # Heading north, to starboard: further is east. Heading east, to port: ahead is east, further is north.
    for image_id, (east_m, north_m) in (("0001", (1.3, 1.1)), ("0002", (1.1, 1.3))):
        extent_m = float(visit.page.get_attribute("dialog.object", "data-scale"))
        assert extent_m == pytest.approx(6.0)
        x, y = visit.page.evaluate(BRIGHTEST, identifier(served, image_id))
        assert (x * extent_m, y * extent_m) == pytest.approx((east_m, north_m), abs=0.15)
    # Ordered by aspect: from the south (180°), from the west (270°).
    order = visit.page.eval_on_selector_all(".tile", "tiles => tiles.map(tile => tile.dataset.id)")
    assert order == [identifier(served, "0002"), identifier(served, "0001")]
    assert visit.text(".aspects") == "Not seen from 280° to 170°"


def test_one_verdict_for_all_looks(served):
    store_two_looks(served)
    visit = open_panel(served)
    assert "for all 2 looks" in visit.text(".object-decision")
    visit.page.evaluate(
        """() => {
          window.sent = [];
          const real = window.fetch;
          window.fetch = (path, ...all) => {
            if (path.endsWith('/decisions')) sent.push(path);
            return real(path, ...all);
          };
        }"""
    )
    visit.wait("dialog[data-ready=true]")
    # A bouncing key sends one verdict.
    visit.page.evaluate(
        """() => {
          for (let i = 0; i < 5; i += 1) {
            const event = new KeyboardEvent('keydown', { key: '1', code: 'Digit1', bubbles: true, cancelable: true });
            document.querySelector('dialog').dispatchEvent(event);
          }
        }"""
    )
    visit.until("() => document.querySelectorAll('.tile .badge.mine_like').length === 2")
    assert [review(served, one) for one in ("0001", "0002", "0003")] == ["mine_like", "mine_like", "unreviewed"]
    visit.wait("dialog[data-ready=true]")
    assert len(visit.page.evaluate("window.sent")) == 1
    # A verdict on one look is made in review; the panel shows the contradiction.
    contact_id = identifier(served, "0002")
    served.client("anna").decide(contact_id, verdict="not_mine_like")
    visit.wait(".tile .badge.not_mine_like")
    visit.wait(".contradiction")
    visit.press("Escape")
    visit.until("() => document.querySelectorAll('.row .mark.contradiction').length === 2")


def test_separate_and_join_looks(served):
    store_two_looks(served)
    # 0003 is 7.5 m from 0001: within the gate of 8 m, but too far apart for looks of one pass. 0004 is outside it.
    served.state.store_image(look("0004", heading_deg=0.0, channel="port", vehicle="uuv-4", north_m=28.0))
    visit = open_panel(served)
    visit.page.click(".object-menu summary")
    assert visit.page.locator("[data-merge]").all_inner_texts() == [
        "uuv-1/0003, 7.5\u202fm away, is the same object: join"
    ]
    visit.page.click(f"[data-split='{identifier(served, '0002')}']")
    visit.until("() => document.querySelectorAll('.tile').length === 1")
    assert "Object, 1 look" in visit.text("#object-title")
    visit.page.click(f"[data-merge='{identifier(served, '0003')}']")
    visit.until(TWO_TILES)
    assert visit.page.locator(f".tile[data-id='{identifier(served, '0003')}']").count() == 1
    visit.page.click(f".tile[data-id='{identifier(served, '0003')}'] .image")
    visit.wait_for_contact("0003")
    assert visit.page.locator("dialog").count() == 0


def test_observer_sees_the_object_only(served):
    store_two_looks(served)
    visit = open_panel(served, user="watch")
    assert not visit.page.locator(".object-menu").is_visible()
    assert visit.page.locator(".object-decision button:enabled").count() == 0


def test_decided_on_less_than_has_arrived(served):
    served.state.store_image(image_record("0001", missing_rows=20))
    visit = served.visit()
    visit.wait_for_contact("0001")
    served.client("bo").decide(identifier(served, "0001"), verdict="not_mine_like")
    served.state.store_image(image_record("0001", version=2))
    visit.page.select_option("#review", "newer_detail")
    visit.until("() => document.querySelector('.row .newer')?.textContent === '○ on 100 B – 200 B are here'")  # noqa: RUF001


def test_earlier_contacts_at_the_place(served):
    served.state.store_image(image_record("0001", first_utc_s=FIRST_UTC_S - 3 * 86400.0))
    served.state.store_image(image_record("0002"))
    visit = served.visit()
    visit.page.click(f".row[data-id='{identifier(served, '0002')}']")
    visit.wait_for_contact("0002")
    visit.wait("details[data-name=earlier]")
    assert "uuv-1/0001" in visit.text("details[data-name=earlier]")
