"""The integrity line, version buttons, requests and layers of a contact, in Chromium."""

from __future__ import annotations

from typing import Any

import pytest
from builders.console import FIRST_UTC_S, image_record

from sonarpost.messages import DownlinkState

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"
LARGE = {"width": 1920, "height": 1080}


def v1_record(version: int, received: int, *, complete: bool = True, image_id: str = "00A7", **fields: Any) -> Any:
    """A version as the v1 link delivers it."""
    record = image_record(image_id, version, **fields)
    changes = {
        "complete": complete,
        "bytes_received": received,
        "bytes_total": received if complete else 0,
        "frames_received": 0,
        "despeckle_strength": 1.0,
    }
    return record.model_copy(update=changes)


def wider_record(version: int = 1, *, complete: bool = True) -> Any:
    fields = {"first_utc_s": FIRST_UTC_S + 60, "time_utc_s": FIRST_UTC_S - 100}
    sizes = {"pixel_along_m": 0.2, "pixel_across_m": 0.1}
    return v1_record(version, 300, complete=complete, image_id="00A9", **fields, **sizes)


def downlink(served: Any, state: str, reason: str = "") -> None:
    [request, *_] = served.state.contact_detail(ID)["requests"]
    served.state.apply_downlink_state(
        DownlinkState(
            vessel_id="vessel-1",
            vehicle_id="uuv-1",
            kind=request["kind"],
            record_id=request["command_id"],
            state=state,
            times_sent=2,
            expires_utc_s=served.state.clock() + 3600,
            changed_utc_s=served.state.clock(),
            reason=reason,
        )
    )


@pytest.fixture
def v1_console(serve: Any) -> Any:
    served = serve(assumed_rate=1)
    served.state.store_image(v1_record(1, 30, complete=False))
    served.state.store_image(v1_record(2, 131))
    return served


def test_integrity_line_states_bytes_and_resolution(v1_console: Any) -> None:
    visit = v1_console.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    strip = visit.text(".strip").replace("\u202f", " ")
    assert "sent 131 B · sharp to ≈" in strip
    assert "Lossy: detail below ≈" in strip
    assert "shared" in strip
    for untrue in ("0.0", "frames", "100", "synthetic"):
        assert untrue not in strip
    visit.page.locator(".versions button").first.click()
    visit.wait(".strip >> text=Preview: more detail is on its way.")
    assert "preview 30 B" in visit.text(".strip").replace("\u202f", " ")
    assert "%" not in visit.text(".row .share") + visit.text(".versions")


def test_row_of_the_queue_names_the_preview(serve: Any) -> None:
    served = serve()
    served.state.store_image(v1_record(1, 30, complete=False))
    visit = served.visit(viewport=LARGE)
    assert visit.text(".row .share").replace("\u202f", " ") == "preview 30 B"


def test_codebook_texture_is_named(serve: Any) -> None:
    served = serve()
    served.state.store_image(image_record().model_copy(update={"codec": "vq"}))
    visit = served.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    strip = visit.text(".strip")
    assert "tiles:" in strip
    assert "Texture from a codebook; edges to ± 10 px." in strip
    assert visit.text('[data-tool="layer-raw"]') == "tiles"


def test_newer_version_is_a_badge_and_does_not_move_the_image(v1_console: Any) -> None:
    visit = v1_console.visit()
    visit.wait_for_contact("00A7")
    visit.press("[")
    visit.wait('.versions [data-version="1"][aria-pressed="true"]')
    before = visit.page.locator(".stage").bounding_box()
    for version, received in ((3, 314), (4, 629)):
        v1_console.state.store_image(v1_record(version, received))
    visit.wait('.versions [data-version="4"] .newer')
    assert visit.page.locator(".stage").bounding_box() == before
    assert visit.page.locator(".versions > span").count() == 0
    visit.page.locator('.versions [data-version="4"]').click()
    visit.until("() => document.querySelectorAll('.versions .newer').length === 0")
    assert visit.page.locator(".stage").bounding_box() == before


def test_request_with_the_mouse_runs_from_order_to_arrival(v1_console: Any) -> None:
    visit = v1_console.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    button = visit.page.locator('[data-request="refine"]')
    assert button.inner_text().startswith("Sharper")
    assert button.inner_text().endswith("s")  # its cost
    button.click()
    visit.wait(".request-states >> text=ordered")
    assert visit.page.locator("dialog").count() == 0
    assert button.is_disabled()
    downlink(v1_console, "confirmed")
    visit.wait(".request-states >> text=accepted by the vehicle; answer pending; not before")
    v1_console.state.store_image(v1_record(3, 196, complete=False))
    visit.wait(".request-states >> text=arriving 50")
    v1_console.state.store_image(v1_record(4, 262))
    visit.wait(".request-states >> text=arrived: v4 (+131")
    visit.until("() => !document.querySelector('[data-request=refine]').disabled")
    assert "refined 262" in visit.text(".strip")


def test_request_on_a_phone(v1_console: Any) -> None:
    visit = v1_console.visit(viewport={"width": 390, "height": 844})
    visit.wait_for_contact("00A7")
    visit.page.locator(".request-menu").click()
    visit.wait("dialog .costs")
    visit.page.locator('dialog [data-action="send"]').click()
    visit.until("() => !document.querySelector('dialog')")
    assert [one["kind"] for one in v1_console.state.contact_detail(ID)["requests"]] == ["refine"]


def test_request_with_keys(v1_console: Any) -> None:
    visit = v1_console.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    visit.page.locator('[data-request="revisit"]').focus()
    visit.press("Enter")
    visit.wait(".request-states >> text=after the vehicle has passed the position")


def test_costly_request_is_confirmed(serve: Any) -> None:
    served = serve()  # no rate is known
    served.state.store_image(v1_record(1, 131))
    visit = served.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    visit.page.locator('[data-request="refine"]').click()
    visit.wait("dialog >> text=The cost is not known")
    visit.press("Escape")
    assert served.state.contact_detail(ID)["requests"] == []


def test_kind_that_the_vehicle_does_not_support_is_not_offered(v1_console: Any) -> None:
    visit = v1_console.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    visit.page.locator('[data-request="revisit"]').click()
    visit.wait(".request-states >> text=ordered")
    downlink(v1_console, "refused", "unsupported")
    visit.wait(".request-buttons >> text=Second pass: uuv-1 cannot do this")
    visit.wait(".request-states >> text=uuv-1 cannot do this (refused, 2 tries)")
    assert visit.page.locator('[data-request="revisit"]').count() == 0


def test_vessel_without_downlink_shows_no_buttons(serve: Any) -> None:
    served = serve(command_consumers=())
    served.state.store_image(v1_record(1, 131))
    visit = served.visit(viewport=LARGE)
    visit.wait(".request-buttons >> text=This vessel sends no requests")
    assert visit.page.locator("[data-request]").count() == 0


def test_observer_has_no_request_buttons(v1_console: Any) -> None:
    visit = v1_console.visit("watch", viewport=LARGE)
    visit.wait_for_contact("00A7")
    assert not visit.page.locator(".requests").is_visible()


def test_wider_view_is_a_layer_of_its_contact(v1_console: Any) -> None:
    visit = v1_console.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    visit.page.locator('[data-request="wider"]').click()
    visit.wait(".request-states >> text=ordered")
    v1_console.state.store_image(wider_record())
    visit.wait(".request-states >> text=arrived: wider view (+300")
    assert visit.page.locator(".row").count() == 1
    assert visit.page.locator('[data-tool="layer-wider"]').count() == 1
    visit.press("-")  # zooming out of the whole image continues into the wider image
    visit.wait('[data-tool="layer-wider"][aria-pressed="true"]')
    visit.until("() => document.querySelector('canvas').dataset.shows.endsWith(' wider')")
    assert visit.pixels() > 1000
    visit.wait(".strip >> text=wider view:")
    assert visit.page.locator('[data-tool="measure"]').get_attribute("aria-disabled") == "true"
    visit.press("e")
    visit.wait('[data-tool="layer-raw"][aria-pressed="true"]')


def test_wheel_continues_into_the_wider_view(v1_console: Any) -> None:
    v1_console.state.store_image(wider_record())
    visit = v1_console.visit(viewport=LARGE)
    visit.wait_for_contact("00A7")
    visit.page.locator(".stage canvas").first.hover()
    visit.page.mouse.wheel(0, 100)
    visit.wait('[data-tool="layer-wider"][aria-pressed="true"]')
